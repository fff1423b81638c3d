"""What a page shows, whatever it comes from: bodies, clouds, ranked grasps and how each is carried out."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from dexgrasp.execution import pregrasp
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.scene import Boxes

Array = NDArray[np.float64]
LIFT = 0.12
"""m"""
FRAMES = {"approach": 25, "close": 20, "lift": 25}
"""Pictures of each part of a motion."""


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
    """Return approach, close and lift of one grasp as it is planned: no physics, the object follows the hand.

    The base comes straight along the palm's approach with open fingers, as the protocols do it.
    """
    hand, grasp = exhibit.hand, exhibit.grasps[number].to("cpu", torch.float64)
    before, start = pregrasp(hand, grasp)
    near, far, closed, open_ = grasp.pose[0].numpy(), before[0].numpy(), grasp.joints[0].numpy(), start[0].numpy()
    shares = {phase: np.linspace(0, 1, count)[:, None] for phase, count in FRAMES.items()}
    count = len(FRAMES)
    base, joints = [], []
    for phase in range(count):
        share = list(shares.values())[phase]
        pose = np.repeat(near[None], len(share), axis=0)
        if phase == 0:
            pose[:, :3, 3] = far[:3, 3] + share * (near[:3, 3] - far[:3, 3])
        if phase == count - 1:
            pose[:, :3, 3] += LIFT * (0.5 - 0.5 * np.cos(np.pi * share)) * np.array(exhibit.up)
        base.append(pose)
        joints.append(open_ + (share if phase == 1 else np.full_like(share, phase > 1)) * (closed - open_))
    poses = np.repeat(resting(exhibit)[None], sum(FRAMES.values()), axis=0)
    held = int(grasp.object[0])
    if 0 <= held < len(exhibit.bodies):
        rise = base[-1][:, :3, 3] - near[:3, 3]
        poses[-len(rise) :, held, :3, 3] += rise
    phases = tuple(phase for phase, frames in FRAMES.items() for _ in range(frames))
    return Motion(np.concatenate(base), np.concatenate(joints), poses, phases)


def resting(exhibit: Exhibit) -> Float[np.ndarray, "O 4 4"]:
    """Return the bodies' poses before anything happens."""
    return np.stack([body.pose for body in exhibit.bodies]) if exhibit.bodies else np.zeros((0, 4, 4))
