"""A grasp told from one fingertip contact: finger projection, main joints, supporting joints."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.contact_frame import place, project
from dexgrasp.geometry import golden_spiral
from dexgrasp.grasps import Grasps
from dexgrasp.staged_contact import StagedContact


class Contact(StagedContact):
    """Parameters: x, y, then joint angles, see `StagedContact` for heads, stages and options.

    With several anchors, a direction of the half sphere above the tangent plane is told and an offset from its (x, y);
    ``anchors=1`` tells (x, y) outright, as in the paper.

    The representation is lossy: it assumes that the contact normal lies in the finger's flexion plane. Where the normal
    leaves it, decode to see what is left of the grasp; where z <= 0 it cannot be told.
    """

    lead = told = 2

    @staticmethod
    def spread(count: int) -> Float[Tensor, "A 3"]:
        """Return anchors over the half sphere z > 0."""
        return golden_spiral(count)

    def direction(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        """Return (x, y, +sqrt(1 - x^2 - y^2))."""
        xy = parameters[:, :2]
        return torch.cat([xy, (1 - xy.square().sum(-1, keepdim=True)).clamp(min=0).sqrt()], dim=-1)

    def measure(
        self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps
    ) -> tuple[Float[Tensor, "N 2"], Bool[Tensor, "N"]]:
        """Return (x, y) and whether z > 0."""
        return project(self.hand, grasps.finger, points, normals, grasps.pose, grasps.joints)

    def relative(self, parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]) -> Float[Tensor, "N 2"]:
        """Return the offset from the anchor's (x, y)."""
        return parameters[:, :2] - self._at(anchor, parameters)

    def miss(
        self, told: Float[Tensor, "N 2"], parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]
    ) -> Float[Tensor, "N"]:
        """Return |xy_p - xy_l|."""
        return torch.linalg.vector_norm(self._at(anchor, told) + told - parameters[:, :2], dim=-1)

    def base(
        self,
        points: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"],
        finger: Int[Tensor, "N"],
        told: Float[Tensor, "N 2"],
        anchor: Int[Tensor, "N"],
        joints: Float[Tensor, "N J"],
    ) -> Float[Tensor, "N 4 4"]:
        """Place the hand; (x, y) outside the unit disc is projected onto it."""
        return place(self.hand, finger, points, normals, self._at(anchor, told) + told, joints)

    def _at(self, anchor: Int[Tensor, "N"], like: Tensor) -> Float[Tensor, "N 2"]:
        return self.anchors[anchor, :2].to(like)
