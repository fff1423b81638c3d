"""Clouds in lexicographic order, on their device: put in order once, then asked for farthest points and neighbours.

Rows of an arranged cloud are ranks by x, then y, then z, then the given order: of equals the first row is the one that
the CPU path takes, and a run of rows lies between two planes of x.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.kernels.farthest import farthest
from dexgrasp.kernels.nearest import nearest

ROWS, COLUMNS = 64, 64
"""Points that a block compares with how many at once."""


@dataclass(frozen=True)
class Arranged:
    """B clouds of N points each."""

    axes: Float[Tensor, "B 3 N"]
    """x, y and z in rising order, m."""
    order: Int[Tensor, "B N"]
    """The rows, int32, that they had."""

    def farthest(self, count: int) -> Int[Tensor, "B count"]:
        """Return `count` rows (int64) of each cloud, see `dexgrasp.sampling.farthest_points`."""
        with _device(self.axes):
            chosen = farthest(self.axes, count)
        return self.order.gather(1, chosen.long()).long()

    def nearest(
        self, centres: Float[Tensor, "B M 3"], count: int, radius: float = float("inf")
    ) -> Int[Tensor, "B M count"]:
        """Return rows (int64) of the nearest `count` points of each centre, see `dexgrasp.sampling.neighbours`."""
        with _device(self.axes):
            return nearest(self.axes, self.order, centres, count, radius)


def arrange(points: Float[Tensor, "B N 3"]) -> Arranged:
    """Return the clouds in order."""
    points = points.detach().float().contiguous()
    batch, total, _ = points.shape
    axes = torch.zeros(batch, 3, total, device=points.device)
    order = torch.zeros(batch, total, dtype=torch.int32, device=points.device)  # NaN has no rank
    with _device(points):
        _arrange[(triton.cdiv(total, ROWS), batch)](points, axes, order, total, ROWS=ROWS, COLUMNS=COLUMNS, num_warps=4)
    return Arranged(axes, order)


def _device(points: Tensor) -> AbstractContextManager[object]:
    """Triton launches on the present device, wherever its tensors lie."""
    return torch.cuda.device(points.device) if points.is_cuda else nullcontext()


@triton.jit
def _arrange(points, axes, order, total, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """A point's rank is the number of points before it: N^2 comparisons, but one launch and no exchange."""
    cloud = tl.program_id(1).to(tl.int64)
    points += cloud * total * 3
    mine = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    real = mine < total
    x = tl.load(points + mine * 3, mask=real, other=0.0)
    y = tl.load(points + mine * 3 + 1, mask=real, other=0.0)
    z = tl.load(points + mine * 3 + 2, mask=real, other=0.0)
    before = tl.zeros((ROWS, COLUMNS), tl.int32)
    for start in range(0, total, COLUMNS):
        other = start + tl.arange(0, COLUMNS)
        there = other < total
        u = tl.load(points + other * 3, mask=there, other=float("inf"))[None, :]
        v = tl.load(points + other * 3 + 1, mask=there, other=float("inf"))[None, :]
        w = tl.load(points + other * 3 + 2, mask=there, other=float("inf"))[None, :]
        last = (w < z[:, None]) | ((w == z[:, None]) & (other[None, :] < mine[:, None]))
        then = (v < y[:, None]) | ((v == y[:, None]) & last)
        before += ((u < x[:, None]) | ((u == x[:, None]) & then)).to(tl.int32)
    rank = tl.sum(before, axis=1)
    axes += cloud * total * 3
    tl.store(order + cloud * total + rank, mine, mask=real)
    tl.store(axes + rank, x, mask=real)
    tl.store(axes + total + rank, y, mask=real)
    tl.store(axes + 2 * total + rank, z, mask=real)
