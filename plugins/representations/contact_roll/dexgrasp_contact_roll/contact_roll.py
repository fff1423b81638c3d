"""A grasp told from one fingertip contact without loss: the finger's direction, its roll, and all joints."""

from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.contact_frame import SINGULAR, contact_frame, finger_direction, tip_rotation
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import axis_angle, golden_spiral, inverse, pose
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.staged_contact import StagedContact
from dexgrasp.tip_surface import TipSurface

FEWEST = 8
"""Of the anchors: fewer leave directions that none of them can tell."""


def upright_frame(normals: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return rotations [x, y, z] with z the horizontal part of the normal and x up; x axis of a vertical one.

    What cameras see of a normal is wrong by its tilt, at the rims of low things above all, and hands come from above.
    The frame of paper equation 2 spins where the normal is along the first axis; this one does so where it is vertical.
    """
    flat = torch.stack([normals[..., 0], normals[..., 1], torch.zeros_like(normals[..., 0])], dim=-1)
    length = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
    z = torch.where(length > SINGULAR, flat / length.clamp(min=SINGULAR), flat.new_tensor([1.0, 0.0, 0.0]))
    x = z.new_tensor([0.0, 0.0, 1.0]).expand_as(z)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


FRAMES = {"normal": contact_frame, "upright": upright_frame}


class ContactRoll(StagedContact):
    """Parameters: X, Y, roll, then joint angles, see `StagedContact` for heads, stages and options.

    (X, Y) tells the unit vector u from the fingertip's centre to the outer joint, in the contact frame: within the unit
    disc it is (x, y) of `contact` (z > 0), beyond it (x, y) (2 - |xy|) / |xy| (z < 0), so that it is continuous and
    -n is the circle of radius 2. The roll (rad) turns the distal link about u from w = u x n, the closing axis that
    `contact` assumes, to the true one. METHOD section 1: orientation first, then the fingertip's support map
    (`TipSurface`) says where its surface touches: centre = p - R s(-R^T n).

    Every fingertip contact can be told. Heads: a direction of the whole sphere, the offset from it in its tangent
    plane, and sine and cosine of the roll.

    Args:
        frame: contact frame in which direction and roll are told: `normal` (paper equation 2), or `upright`, whose z is
            the horizontal part of the normal and whose x points up (z of the points' frame, the level one).
        hand, channels, options: see `StagedContact`.
    """

    lead, told = 3, 4
    label_options = ("frame",)

    def __init__(self, hand: Hand, channels: int, *, frame: str = "normal", **options: Any) -> None:
        if frame not in FRAMES:
            raise DexgraspError(f"repr.frame to be one of {sorted(FRAMES)}", repr(frame), "choose one of them")
        self.frame = FRAMES[frame]
        super().__init__(hand, channels, **options)

    @cached_property
    def tips(self) -> TipSurface:
        """The fingertips' surfaces."""
        return TipSurface(self.hand)

    def tip_contacts(self, finger: Int[Tensor, "N"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return the support points of the fingertips."""
        return self.tips.support(finger, directions)

    @staticmethod
    def spread(count: int) -> Float[Tensor, "A 3"]:
        """Return anchors over the whole sphere, each direction within the half sphere about one of them."""
        if count < FEWEST:
            raise DexgraspError(
                f"repr.anchors of at least {FEWEST}", str(count), "one half sphere does not hold them all"
            )
        return golden_spiral(count, lowest=-1.0)

    def direction(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        """Return u in the contact frame."""
        radius = torch.linalg.vector_norm(parameters[:, :2], dim=-1, keepdim=True).clamp(max=2.0)
        above = radius <= 1
        inner = torch.where(above, radius, 2 - radius)
        xy = parameters[:, :2] * torch.where(above, 1.0, inner / radius.clamp(min=1.0))
        z = (1 - inner.square()).clamp(min=0.0).sqrt()
        return torch.cat([xy, torch.where(above, z, -z)], dim=-1)

    def measure(
        self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps
    ) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
        """Return (X, Y, roll); every grasp can be told."""
        frame = self.frame(normals)
        rotation = (grasps.pose @ self._tip(grasps.finger, grasps.joints))[:, :3, :3]
        xyz = (frame.transpose(-1, -2) @ rotation[:, :, :1]).squeeze(-1)
        xy, z = xyz[:, :2], xyz[:, 2:]
        radius = torch.linalg.vector_norm(xy, dim=-1, keepdim=True)
        # Straight into the surface (-n) every side is right; one is chosen.
        outward = torch.where(radius > SINGULAR, xy / radius.clamp(min=SINGULAR), xy.new_tensor([1.0, 0.0]))
        folded = torch.where(z >= 0, xy, outward * (2 - radius))
        straight = tip_rotation(rotation[:, :, 0], frame)
        turned = straight.transpose(-1, -2) @ rotation[:, :, 2:]
        roll = torch.atan2(-turned[:, 1], turned[:, 2])
        return torch.cat([folded, roll], dim=-1), torch.ones(len(points), dtype=torch.bool, device=points.device)

    def relative(self, parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]) -> Float[Tensor, "N 4"]:
        """Return u in the anchor's tangent plane, and sine and cosine of the roll."""
        frame = contact_frame(self.anchors.to(parameters))[anchor]
        offset = (frame.transpose(-1, -2) @ self.direction(parameters).unsqueeze(-1)).squeeze(-1)[:, :2]
        roll = parameters[:, 2:3]
        return torch.cat([offset, roll.sin(), roll.cos()], dim=-1)

    def miss(
        self, told: Float[Tensor, "N 4"], parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]
    ) -> Float[Tensor, "N"]:
        """Return the distances of the offset and of the roll's sine and cosine."""
        off = told - self.relative(parameters, anchor)
        return torch.linalg.vector_norm(off[:, :2], dim=-1) + torch.linalg.vector_norm(off[:, 2:], dim=-1)

    def base(
        self,
        points: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"],
        finger: Int[Tensor, "N"],
        told: Float[Tensor, "N 4"],
        anchor: Int[Tensor, "N"],
        joints: Float[Tensor, "N J"],
    ) -> Float[Tensor, "N 4 4"]:
        """Turn the distal link first, then lay its surface against the point."""
        frame = self.frame(normals)
        xyz = finger_direction(told[:, :2], contact_frame(self.anchors.to(told))[anchor])
        u = (frame @ xyz.unsqueeze(-1)).squeeze(-1)
        rotation = axis_angle(u, torch.atan2(told[:, 2], told[:, 3])) @ tip_rotation(u, frame)
        inward = -(rotation.transpose(-1, -2) @ normals.unsqueeze(-1)).squeeze(-1)
        center = points - (rotation @ self.tip_contacts(finger, inward).unsqueeze(-1)).squeeze(-1)
        return pose(rotation, center) @ inverse(self._tip(finger, joints))

    def _tip(self, finger: Int[Tensor, "N"], joints: Float[Tensor, "N J"]) -> Float[Tensor, "N 4 4"]:
        return self.hand.fingertips(joints)[torch.arange(len(finger), device=finger.device), finger]
