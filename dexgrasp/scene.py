"""A scene of objects on a table, and a camera's view of it."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Scene:
    """Objects at rest on the table. World frame: z up, table surface at z = 0, metres."""

    objects: tuple[str, ...]
    """Names in an `ObjectSet`."""
    poses: Float[Tensor, "O 4 4"]
    """world_T_object, m."""
    seed: int

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
