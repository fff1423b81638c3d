"""Grasps and what became of them."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.batch import Batch


@dataclass(frozen=True)
class Grasps(Batch):
    """N grasps of one hand; nothing here belongs to a representation.

    The frame of `pose`, `contacts` and `normals` is the holder's: object frame in a grasp store, world frame in a
    scene, camera frame in a view and in predictions.
    """

    pose: Float[Tensor, "N 4 4"]
    """frame_T_base: the hand's base, m."""
    joints: Float[Tensor, "N J"]
    """Independent joints in the hand's order, rad (m where prismatic)."""
    contacts: Float[Tensor, "N F 3"]
    """Contact point of each fingertip, m; NaN where a finger does not touch or is not known to."""
    normals: Float[Tensor, "N F 3"]
    """Outward unit normal of the object at each contact; NaN as in `contacts`."""
    finger: Int[Tensor, "N"]
    """Index of the finger from which the grasp is told (0..F-1); -1 where none was chosen."""
    object: Int[Tensor, "N"]
    """Index of the object in its scene or set; -1 where unknown."""
    quality: Float[Tensor, "N"]
    """Epsilon quality of synthesised grasps; score (higher is better) of predicted ones."""
    touching: Bool[Tensor, "N F"]
    """Fingers that close until they touch; the others stay as `joints` tell them, open and out of the way."""

    @classmethod
    def none(cls, joints: int, fingers: int) -> "Grasps":
        """Return no grasps of a hand with so many joints and fingers, float64."""
        return cls.build(torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, joints).double(), fingers)

    @classmethod
    def build(
        cls,
        pose: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        fingers: int,
        *,
        finger: Tensor | None = None,
        quality: Tensor | None = None,
        touching: Tensor | None = None,
    ) -> "Grasps":
        """Return grasps of which only pose and joints are known; contacts are NaN, object -1, all fingers touching."""
        count = len(pose)
        unknown = pose.new_full((count, fingers, 3), float("nan"))
        none = torch.full((count,), -1, dtype=torch.long, device=pose.device)
        return cls(
            pose=pose,
            joints=joints,
            contacts=unknown,
            normals=unknown.clone(),
            finger=none if finger is None else finger,
            object=none.clone(),
            quality=pose.new_zeros(count) if quality is None else quality,
            touching=torch.ones_like(unknown[..., 0], dtype=torch.bool) if touching is None else touching,
        )

    def moved(self, a_T_b: Float[Tensor, "4 4"]) -> "Grasps":
        """Carry grasps from frame b to frame a."""
        motion = a_T_b.to(self.pose)
        rotation = motion[:3, :3].T
        return self.replace(
            pose=motion @ self.pose,
            contacts=self.contacts @ rotation + motion[:3, 3],
            normals=self.normals @ rotation,
        )


class Reason(IntEnum):
    """How an attempt ended; by how much is moved, raised or inside, the protocol's `verdict` says.

    The first that applies is told: NO_GRASP, COLLIDED, MULTIPLE, SUCCESS, SLIPPED, TOPPLED, NOT_LIFTED, MISSED.
    """

    SUCCESS = 0
    """At the end the object, and only it, is lifted and held (or is lifted, where the protocol is not `exclusive`)."""
    NO_GRASP = 1
    """Nothing was tried: no grasp was offered, or the protocol skips it for its tilt."""
    COLLIDED = 2
    """On its way the open hand was inside something, moved an object or was stopped short; it did not close."""
    MISSED = 3
    """The closed hand touched no object and moved none away: it closed beside it, or slid off. Where a target was
    given: it holds another object."""
    TOPPLED = 4
    """An object was pushed away or over; none left the table."""
    SLIPPED = 5
    """An object left the table, but at the end it is not held high enough: dropped, thrown, or slid down."""
    MULTIPLE = 6
    """An object is lifted and held, and another was raised with it."""
    NOT_LIFTED = 7
    """The closed hand touched an object, yet none left the table or was moved away: no grip, or too weak a one."""


@dataclass(frozen=True)
class Outcomes(Batch):
    """What a simulator saw of N executed grasps, each from the same initial scene of O objects."""

    success: Bool[Tensor, "N"]
    reason: Int[Tensor, "N"]
    """A `Reason`."""
    object: Int[Tensor, "N"]
    """Index of the object that was held (or was touched first); -1 for none."""
    height: Float[Tensor, "N"]
    """Rise of that object's centre of mass at the end, m."""
    final: Float[Tensor, "N O 4 4"]
    """world_T_object of all objects at the end of each attempt, m."""
