"""From one fingertip contact to the hand's base and back (METHOD section 1, paper equations 1 to 5)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.geometry import inverse, pose
from dexgrasp.hand import Hand

SINGULAR = 1e-6
"""Sine below which two directions count as parallel, so that the documented fallbacks apply."""


def contact_frame(normals: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return rotations [x, y, z] with z = n, orthonormal and right-handed for every unit normal.

    Paper equation 2, mended: y = [0, -n3, n2] is normalised; where n is parallel to the first axis, so that it
    vanishes, y is the second axis made orthogonal to n.
    """
    n1, n2, n3 = normals.unbind(-1)
    y = torch.stack([torch.zeros_like(n1), -n3, n2], dim=-1)
    fallback = torch.zeros_like(y)
    fallback[..., 1] = 1
    y = _unit(torch.where(_norm(y) < SINGULAR, _orthogonal(fallback, normals), y))
    return torch.stack([torch.linalg.cross(y, normals), y, normals], dim=-1)


def to_disc(xy: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """Project finger projections onto the unit disc; those within it stay."""
    return xy / _norm(xy).clamp(min=1.0)


def finger_direction(xy: Float[Tensor, "*b 2"], frame: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the unit vector u from fingertip centre to outer joint (paper equation 3).

    z = +sqrt(1 - x^2 - y^2): the outer joint lies on the outer side of the tangent plane. `xy` outside the unit
    disc is projected onto it.
    """
    # z of the given numbers: of projected ones, it would be the root of their rounding error, 3e-4 and not 0.
    z = (1 - xy.square().sum(-1, keepdim=True)).clamp(min=0.0).sqrt()
    return (frame @ torch.cat([to_disc(xy), z], dim=-1).unsqueeze(-1)).squeeze(-1)


def tip_rotation(u: Float[Tensor, "*b 3"], frame: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the fingertip's axes [u, w x u, w] with w = u x n / |u x n| (paper equation 4).

    The paper prints u x (u x n) for the second axis, which makes the frame left-handed: mended. Where u is parallel
    to n, w is the limit for a finger that leans towards the contact frame's +x: minus its y axis, made orthogonal
    to u.
    """
    w = torch.linalg.cross(u, frame[..., 2])
    w = _unit(torch.where(_norm(w) < SINGULAR, _orthogonal(-frame[..., 1], u), w))
    return torch.stack([u, torch.linalg.cross(w, u), w], dim=-1)


def place(
    hand: Hand,
    finger: Int[Tensor, "N"],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    xy: Float[Tensor, "N 2"],
    joints: Float[Tensor, "N J"],
) -> Float[Tensor, "N 4 4"]:
    """Return frame_T_base of N hands, each of which touches `points` with its finger `finger` (0..F-1).

    `points` (m) and outward unit `normals` are in one frame; only the chain of that finger matters in `joints`
    (rad). The fingertip circle touches the tangent plane: its centre is p + r n. Paper equation 5.
    """
    frame = contact_frame(normals)
    u = finger_direction(xy, frame)
    frame_T_tip = pose(tip_rotation(u, frame), tip_centers(hand, finger, points, normals))
    return frame_T_tip @ inverse(_chosen(hand.fingertips(joints), finger))


def project(
    hand: Hand,
    finger: Int[Tensor, "N"],
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    frame_T_base: Float[Tensor, "N 4 4"],
    joints: Float[Tensor, "N J"],
) -> tuple[Float[Tensor, "N 2"], Bool[Tensor, "N"]]:
    """Return the finger projections (x, y) of N hands and whether each can be told (z > 0).

    u is taken from the fingertip centre that `place` will assume, p + r n, to the true outer joint. The inverse of
    `place` where the fingertip circle touches the tangent plane and n lies in the finger's flexion plane; otherwise
    `place` gives back another pose (the representation is lossy).
    """
    frame_T_tip = frame_T_base @ _chosen(hand.fingertips(joints), finger)
    reach = points.new_tensor([f.reach for f in hand.fingers])[finger].unsqueeze(-1)
    outer_joint = frame_T_tip[..., :3, 3] + reach * frame_T_tip[..., :3, 0]
    u = _unit(outer_joint - tip_centers(hand, finger, points, normals))
    xyz = (contact_frame(normals).transpose(-1, -2) @ u.unsqueeze(-1)).squeeze(-1)
    return xyz[..., :2], xyz[..., 2] > 0


def tip_centers(
    hand: Hand, finger: Int[Tensor, "N"], points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return the centres of fingertip circles that touch at `points` (m): c = p + r n (paper equation 1)."""
    return points + points.new_tensor([f.tip_radius for f in hand.fingers])[finger].unsqueeze(-1) * normals


def _chosen(per_finger: Float[Tensor, "N F 4 4"], finger: Int[Tensor, "N"]) -> Float[Tensor, "N 4 4"]:
    return per_finger[torch.arange(len(finger), device=finger.device), finger]


def _orthogonal(vectors: Tensor, unit: Tensor) -> Tensor:
    return vectors - (vectors * unit).sum(-1, keepdim=True) * unit


def _norm(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)


def _unit(vectors: Tensor) -> Tensor:
    return vectors / _norm(vectors)
