"""The Planner interface: grasps for a scene by other means than a network on points (baselines, one's own code)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes, View

if TYPE_CHECKING:
    from dexgrasp.dataset.dataset import Dataset


@dataclass(frozen=True)
class Situation:
    """One look at a scene, and what truly lies there. World frame: z up, table at z = 0, metres."""

    view: View
    """What the camera sees; `view.instance` is the row in `objects` of each point, -1 for the table."""
    objects: tuple[Object, ...]
    """What still lies there; for planners that are granted known meshes (`Planner.grants`), and for no other."""
    poses: Float[Tensor, "O 4 4"]
    """world_T_object, float64."""
    fixtures: Boxes | None
    """Walls of a bin, if any."""
    seed: int
    """Of all that is random in answering this look."""


class Planner(ABC):
    """A way to grasps.

    Constructor: ``(hand, **options)``; the options are the keys of its YAML, `conf/planner/<name>.yaml`.
    """

    grants: str = "points"
    """What of a `Situation` it uses, for tables: "points", "points and masks", "meshes and poses"."""

    learns: bool = False
    """Whether there is something to `fit` before it plans."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand

    @abstractmethod
    def plan(self, situation: Situation, top_k: int) -> Grasps:
        """Return at most `top_k` grasps, best first, in the camera frame; `quality` is the planner's own score."""

    def fit(self, dataset: "Dataset", seed: int, folder: Path) -> dict[str, Any]:
        """Learn from a dataset's split "train", write what was learnt into `folder`, return facts for its report.

        Raises:
            DexgraspError: this planner learns nothing.
        """
        raise DexgraspError("a planner that learns", f"{type(self).__name__}, which does not", "use it as it is")
