"""A scene of objects on a table, with walls or without, and a camera's view of it."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Boxes:
    """Solid boxes that stand fixed in the world, such as the walls of a bin. World frame, metres."""

    poses: Float[Tensor, "K 4 4"]
    """world_T_box, float64; the box's frame is in its middle."""
    halves: Float[Tensor, "K 3"]
    """Half the lengths of its sides, m, float64."""

    def __len__(self) -> int:
        return len(self.halves)


def no_boxes() -> Boxes:
    """Return what stands on an empty table."""
    return Boxes(torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64))


@dataclass(frozen=True)
class Scene:
    """Objects at rest on the table. World frame: z up, table surface at z = 0, metres."""

    objects: tuple[str, ...]
    """Names in an `ObjectSet`."""
    poses: Float[Tensor, "O 4 4"]
    """world_T_object, m."""
    seed: int
    fixtures: Boxes = field(default_factory=no_boxes)
    """What stands fixed beside the objects."""

    def __len__(self) -> int:
        return len(self.objects)


@dataclass(frozen=True)
class View:
    """One camera's cloud of a scene. Camera frame: x right, y down, z forward, metres."""

    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    """Estimated from the observed cloud, unit length, towards the camera."""
    instance: Int[Tensor, "N"]
    """True object index of each point, -1 for table and background. For labels and reports, never a network input."""
    world_T_camera: Float[Tensor, "4 4"]

    def __len__(self) -> int:
        return len(self.points)
