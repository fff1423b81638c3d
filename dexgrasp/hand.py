"""The Hand interface: fingers on a base, moved by J independent joints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

if TYPE_CHECKING:
    from dexgrasp.synergies import Synergy


@dataclass(frozen=True, eq=False)
class Finger:
    """What the contact representation needs of a finger (METHOD section 1). Link coordinates, metres, float64."""

    name: str
    link: str
    """Distal link, which carries the fingertip."""
    tip_radius: float
    """Radius r of the fingertip circle, m."""
    tip_center: Float[Tensor, "3"]
    """Centre c of the fingertip circle, in the joint's mid-plane."""
    outer_joint: Float[Tensor, "3"]
    """Origin of the distal (outer) joint; a virtual one for prismatic fingers."""
    closing_axis: Float[Tensor, "3"]
    """Signed unit axis w_l: turning the link about +w presses the fingertip into the object."""
    chain: tuple[str, ...]
    """Independent joints between base and distal link, in the hand's order."""
    main: tuple[str, ...]
    """Main joints: the chain and the hand's shared joints, in the hand's order."""
    supporting: tuple[str, ...]
    """All other independent joints, in the hand's order."""
    closing: Mapping[str, float]
    """Independent joints that close this finger and their rates (signed; 1 = towards the upper limit)."""

    @cached_property
    def reach(self) -> float:
        """Distance |v| from fingertip centre to outer joint, m."""
        return float(torch.linalg.vector_norm(self.outer_joint - self.tip_center))

    @cached_property
    def tip_axis(self) -> Float[Tensor, "3"]:
        """Unit vector u_l from fingertip centre to outer joint."""
        return (self.outer_joint - self.tip_center) / self.reach

    @cached_property
    def tip_frame(self) -> Float[Tensor, "4 4"]:
        """link_T_tip, axes [u, w x u, w], origin at the fingertip circle's centre."""
        frame = torch.eye(4, dtype=torch.float64)
        u, w = self.tip_axis, self.closing_axis
        frame[:3, :3] = torch.stack([u, torch.linalg.cross(w, u), w], dim=1)
        frame[:3, 3] = self.tip_center
        return frame


class Hand(ABC):
    """Abstract hand. Base frame: the root link. Everything in metres and radians.

    Attributes are set by the constructor of an implementation; `UrdfHand` is the usual one.
    """

    name: str
    joint_names: tuple[str, ...]
    """Independent joints; this order holds everywhere."""
    limits: Float[Tensor, "J 2"]
    """Lower and upper limit of each independent joint, float64."""
    efforts: Float[Tensor, "J"]
    """Torque (N m) or force (N) limit of each independent joint, at that joint."""
    fingers: tuple[Finger, ...]
    least_fingers: int = 2
    """Fewest fingers that touch in a grasp, where nothing else is asked for; a hand with fewer uses all."""
    link_names: tuple[str, ...]
    base_T_palm: Float[Tensor, "4 4"]
    """Palm frame: origin on the palm's face, z = approach direction (towards the object)."""
    visuals: Mapping[str, trimesh.Trimesh]
    """Mesh of each link that has one, link coordinates."""
    collisions: Mapping[str, tuple[trimesh.Trimesh, ...]]
    """Convex parts of each link that has some, link coordinates."""
    synergies: "Mapping[str, Synergy]" = MappingProxyType({})
    """By name: what postures are drawn from in synthesis; empty: every joint by itself."""

    @abstractmethod
    def link_poses(self, joints: Float[Tensor, "N J"]) -> dict[str, Float[Tensor, "N 4 4"]]:
        """Return base_T_link of every link for N joint vectors; differentiable, dtype and device of `joints`."""

    def fingertips(self, joints: Float[Tensor, "N J"]) -> Float[Tensor, "N F 4 4"]:
        """Return base_T_tip: origin at the fingertip circle's centre, axes [u, w x u, w].

        u points from the centre to the outer joint, w is the signed closing axis.
        """
        poses = self.link_poses(joints)
        return torch.stack([poses[f.link] @ f.tip_frame.to(joints) for f in self.fingers], dim=1)

    def joint_index(self, names: tuple[str, ...]) -> list[int]:
        """Return the positions of named independent joints."""
        return [self.joint_names.index(name) for name in names]

    def clamp(self, joints: Float[Tensor, "N J"]) -> Float[Tensor, "N J"]:
        """Return joints brought within the limits."""
        limits = self.limits.to(joints)
        return joints.clamp(limits[:, 0], limits[:, 1])
