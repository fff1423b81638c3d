"""Triton kernels of `dexgrasp.sampling` for CUDA, for batches of clouds; the rows that the CPU path finds.

Triton comes with the CUDA builds of torch. Without it, or on the CPU, `usable` is False and nothing here is imported.
"""

from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from dexgrasp.kernels.arranged import Arranged


@cache
def _installed() -> bool:
    return find_spec("triton") is not None


def usable(points: Tensor) -> bool:
    """Tell whether the kernels can run where `points` lie."""
    return points.is_cuda and _installed()


def arrange(points: Float[Tensor, "B N 3"]) -> "Arranged":
    """Return clouds that can be asked for farthest points and neighbours, several times."""
    from dexgrasp.kernels import arranged

    return arranged.arrange(points)
