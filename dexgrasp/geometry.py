"""Rigid motions and frames. `a_T_b` maps b-coordinates into a; everything batches over leading axes."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F


def pose(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Join rotation and translation (m) into homogeneous matrices."""
    top = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def inverse(a_T_b: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Return b_T_a of a rigid motion (transposed rotation, no linear solve)."""
    rotation = a_T_b[..., :3, :3].transpose(-1, -2)
    return pose(rotation, -(rotation @ a_T_b[..., :3, 3:]).squeeze(-1))


def transform(a_T_b: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Carry one point per motion from b to a (m)."""
    return rotate(a_T_b, points) + a_T_b[..., :3, 3]


def rotate(a_T_b: Float[Tensor, "*b 4 4"], vectors: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Carry one direction per motion from b to a."""
    return (a_T_b[..., :3, :3] @ vectors.unsqueeze(-1)).squeeze(-1)


def axis_angle(axis: Float[Tensor, "*b 3"], angle: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Return the rotation by `angle` (rad) about the unit vector `axis` (Rodrigues)."""
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*axis.shape[:-1], 3, 3)
    sine, cosine = torch.sin(angle)[..., None, None], torch.cos(angle)[..., None, None]
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return eye + sine * cross + (1 - cosine) * (cross @ cross)


def orthonormal(columns: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Return right-handed rotations whose first two columns these are, by Gram-Schmidt.

    Parallel or zero columns fall back on the axes (Zhou et al. 2019, "On the continuity of rotation representations").
    """
    first, second = columns.split(3, dim=-1)
    eye = torch.eye(3).to(columns)
    x = F.normalize(torch.where(first.norm(dim=-1, keepdim=True) < 1e-6, eye[0], first), dim=-1)
    y = second - (second * x).sum(-1, keepdim=True) * x
    # The axis least along x is never parallel to it.
    spare = eye[x.abs().argmin(-1)]
    spare = spare - (spare * x).sum(-1, keepdim=True) * x
    y = F.normalize(torch.where(y.norm(dim=-1, keepdim=True) < 1e-6, spare, y), dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def golden_spiral(count: int, lowest: float = 0.0) -> Float[Tensor, "A 3"]:
    """Return unit vectors, float64, spread evenly over the part of the sphere with z > `lowest`; a single one is +z."""
    if count == 1:
        return torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    number = torch.arange(count, dtype=torch.float64)
    z = 1 - (1 - lowest) * (number + 0.5) / count
    turn = math.pi * (3 - 5**0.5) * number
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), z], dim=-1)


def rotation_angle(a: Float[Tensor, "*#b 3 3"], b: Float[Tensor, "*#b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the geodesic angle between rotations (rad), accurate near 0 and near pi."""
    chord = torch.linalg.matrix_norm(a - b) / (2 * 2**0.5)
    return 2 * torch.asin(chord.clamp(max=1.0))


def look_at(eye: Float[Tensor, "3"], target: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """Return world_T_camera (float64) of a camera without roll: image x is horizontal, image y points down.

    Straight above the target, where that leaves the turn open, image x is the world's x.
    """
    forward = torch.nn.functional.normalize(target.double() - eye.double(), dim=0)
    up = forward.new_tensor([0.0, 0.0, 1.0])
    right = torch.linalg.cross(forward, up)
    if right.norm() < 1e-6:
        right = forward.new_tensor([1.0, 0.0, 0.0])
    right = torch.nn.functional.normalize(right, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose[:3, 3] = eye
    return pose
