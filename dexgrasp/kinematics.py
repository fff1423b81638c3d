"""Batched, differentiable forward kinematics, compiled from a Pinocchio model."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.forward_kinematics import chained


@dataclass(frozen=True, eq=False)
class LinkRecord:
    """One link of the kinematic tree and the joint that carries it (float64, m)."""

    name: str
    parent: int
    """Position of the parent link in the tree; -1 for the root."""
    joint: str | None
    """Movable joint between parent and this link; None where it is fixed."""
    kind: str
    """`fixed`, `revolute` or `prismatic`."""
    parent_T_joint: np.ndarray
    """(4, 4) joint frame (= this link's frame at zero) in the parent link."""
    axis: np.ndarray
    """(3,) unit axis in the joint frame; zero where fixed."""
    index: int
    """Position of the joint in the full joint vector; -1 where fixed."""


class KinematicTree:
    """Links in topological order and their poses as a function of all M movable joints.

    A joint's motion is P (I + sin q K + (1 - cos q) K^2 + q D) with constant P, K (rotation) and D (translation), so
    the local transforms of all links are one weighted sum of constants.
    """

    def __init__(self, model: pin.Model) -> None:
        self.records = _records(model)
        self.names = tuple(record.name for record in self.records)
        self._constants = torch.from_numpy(np.stack([_constants(record) for record in self.records]))
        self._index = torch.tensor([max(record.index, 0) for record in self.records])
        self._parents = tuple(record.parent for record in self.records)
        above = [[record.parent, max(record.index, 0)] for record in self.records]
        self._above = np.array(above).reshape(-1, 2)
        self._moves = np.array([record.index >= 0 for record in self.records])
        self._cache: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor]] = {}

    def poses(self, full: Float[Tensor, "N M"]) -> dict[str, Float[Tensor, "N 4 4"]]:
        """Return base_T_link of every link; gradients flow, dtype and device are those of `full`."""
        constants, index = self._placed(full)
        differentiable = torch.is_grad_enabled() and full.requires_grad
        plain = full.device.type == "cpu" and full.dtype in (torch.float32, torch.float64)
        if plain and not differentiable and not torch.compiler.is_compiling():
            out = torch.empty(len(self.names), len(full), 4, 4, dtype=full.dtype)
            arrays = full.detach().contiguous().numpy(), constants.numpy()
            chained(*arrays, self._above, self._moves, out.numpy())
            return dict(zip(self.names, out.unbind(), strict=True))
        angles = full[:, index] if full.shape[1] else full.new_zeros(len(full), len(index))
        weights = torch.stack([torch.ones_like(angles), angles.sin(), 1 - angles.cos(), angles], dim=-1)
        local = torch.einsum("nlk,lkij->nlij", weights, constants)
        poses: list[Tensor] = []
        for link, parent in enumerate(self._parents):
            poses.append(local[:, link] if parent < 0 else poses[parent] @ local[:, link])
        return dict(zip(self.names, poses, strict=True))

    def _placed(self, like: Tensor) -> tuple[Tensor, Tensor]:
        key = (like.dtype, like.device)
        if key not in self._cache:
            self._cache[key] = (self._constants.to(like), self._index.to(like.device))
        return self._cache[key]


def _records(model: pin.Model) -> tuple[LinkRecord, ...]:
    bodies = [i for i, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY]
    position = {frame: number for number, frame in enumerate(bodies)}
    records = []
    for body in bodies:
        frame = model.frames[body]
        above = model.frames[frame.parentFrame]
        if frame.parentFrame == 0 or above.name == "universe":
            eye = np.eye(4)
            records.append(LinkRecord(frame.name, -1, None, "fixed", eye, np.zeros(3), -1))
            continue
        parent_frame = model.frames[above.parentFrame]
        inner = parent_frame.placement.inverse()
        if above.type == pin.FrameType.JOINT:
            number = above.parentJoint
            kind, axis = _joint_motion(model, number)
            placement = (inner * model.jointPlacements[number]).homogeneous
            joint, index = model.names[number], model.joints[number].idx_v
        else:
            kind, axis, joint, index = "fixed", np.zeros(3), None, -1
            placement = (inner * frame.placement).homogeneous
        parent = position[above.parentFrame]
        records.append(LinkRecord(frame.name, parent, joint, kind, placement, axis, index))
    return tuple(records)


def _joint_motion(model: pin.Model, number: int) -> tuple[str, np.ndarray]:
    joint = model.joints[number]
    if joint.nv != 1:
        raise DexgraspError(
            "revolute, continuous, prismatic or fixed joints",
            f"joint {model.names[number]!r} with {joint.nv} degrees of freedom",
            "replace it by joints of one degree of freedom",
        )
    data = joint.createData()
    joint.calc(data, pin.neutral(model))
    subspace = np.asarray(data.S).reshape(6)
    if np.abs(subspace[3:]).max() > 0.5:
        return "revolute", subspace[3:].copy()
    return "prismatic", subspace[:3].copy()


def _constants(record: LinkRecord) -> np.ndarray:
    """Return the (4, 4, 4) constants of one joint: at rest, times sin q, times 1 - cos q, times q."""
    turn, slide = np.zeros((4, 4)), np.zeros((4, 4))
    x, y, z = record.axis
    if record.kind == "revolute":
        turn[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    elif record.kind == "prismatic":
        slide[:3, 3] = record.axis
    rest = record.parent_T_joint
    return np.stack([rest, rest @ turn, rest @ turn @ turn, rest @ slide])
