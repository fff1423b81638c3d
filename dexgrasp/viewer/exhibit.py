"""What a page shows, whatever it comes from: bodies, clouds, ranked grasps and how each is carried out."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.motion import TrajectorySettings, trajectory
from dexgrasp.scene import Boxes

Array = NDArray[np.float64]
LIFT = 0.12
"""m"""
RATE = 25.0
"""Pictures of a planned motion in a second."""


@dataclass(frozen=True, eq=False)
class Body:
    """One object, by its mesh or by the points that were seen of it."""

    name: str
    shape: trimesh.Trimesh | Array
    """Mesh in its own frame, or points (P, 3) in the frame of `pose`, m."""
    pose: Array
    """frame_T_body (4, 4), m."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A hand and the bodies over T pictures."""

    base: Float[np.ndarray, "T 4 4"]
    joints: Float[np.ndarray, "T J"]
    bodies: Float[np.ndarray, "T O 4 4"]
    """NaN: not there."""
    phases: tuple[str, ...]
    """Name of what happens in each picture."""
    verdict: str = ""

    def __len__(self) -> int:
        return len(self.base)


@dataclass(frozen=True, eq=False)
class Exhibit:
    """One scene with ranked grasps; everything in one frame, m."""

    title: str
    hand: Hand
    bodies: tuple[Body, ...]
    """`Grasps.object` counts them."""
    grasps: Grasps
    """Best first."""
    notes: tuple[str, ...]
    """Markdown of each grasp."""
    points: Float[np.ndarray, "P 3"] | None = None
    """A view of it all."""
    colours: dict[str, UInt8[np.ndarray, "P 3"]] = field(default_factory=dict)
    """By name: what the colours of the points may tell; the first is shown."""
    fixtures: Boxes | None = None
    friction: float = 0.5
    """Of the cones that are drawn."""
    camera: Array | None = None
    """frame_T_camera (4, 4) of the view."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    floor: Array | None = None
    """frame_T_table (4, 4): z up, surface at z = 0; None: nobody knows."""
    simulate: Callable[[int], Motion] | None = None
    """Carries a grasp out in physics."""


def planned(exhibit: Exhibit, number: int) -> Motion:
    """Return approach, close and lift of one grasp as `trajectory` plans them: no physics, the object follows the hand.

    The fingers stop at the grasp's joints: a squeeze would show them inside the object.
    """
    grasp = exhibit.grasps[number]
    settings = TrajectorySettings(squeeze=0.0, lift=LIFT, rate=RATE)
    way = trajectory(grasp, exhibit.hand, settings, up=exhibit.up)
    commanded = [way.joint_names.index(name) for name in way.independent]
    poses = np.repeat(resting(exhibit)[None], len(way), axis=0)
    held = int(grasp.object[0])
    if 0 <= held < len(exhibit.bodies):
        rise = way.pose[:, :3, 3] - way.pose[way.ends[2], :3, 3]
        poses[way.ends[2] :, held, :3, 3] += rise[way.ends[2] :]
    return Motion(way.pose, way.joints[:, commanded], poses, way.phase)


def resting(exhibit: Exhibit) -> Float[np.ndarray, "O 4 4"]:
    """Return the bodies' poses before anything happens."""
    return np.stack([body.pose for body in exhibit.bodies]) if exhibit.bodies else np.zeros((0, 4, 4))
