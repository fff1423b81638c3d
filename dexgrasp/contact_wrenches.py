"""Wrenches at the edges of friction cones: of arrays compiled, of tensors differentiable.

A hard finger (point contact with friction) presses with unit normal force inside a circular cone. A soft finger also
turns about the normal, up to `torsion` (m): its forces and torques fill an ellipsoid,
(f_x^2 + f_y^2) / friction^2 + (m_n / torsion)^2 <= f_n^2 (Howe & Cutkosky 1996; the elliptic limit surface).
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

LATITUDES = (0.25 * math.pi, -0.25 * math.pi)
"""Of the rings that a soft finger's ellipsoid has besides its equator, which is the hard finger's cone."""


@lru_cache
def cone_edges(edges: int, soft: bool) -> Float[np.ndarray, "P 3"]:
    """Return unit-sphere coordinates (along t_x, t_y, and about the normal) of one contact's wrenches.

    Hard: `edges` on the equator, the k-th at the angle 2 pi k / edges. Soft: then as many on each of the rings at
    +-45 deg, and the two poles: 3 edges + 2. The rings' edges lie at the equator's angles.
    """
    angle = 2 * math.pi / edges * np.arange(edges)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(edges)], axis=1)
    if not soft:
        return circle
    rings = [circle * math.cos(latitude) + [0, 0, math.sin(latitude)] for latitude in LATITUDES]
    return np.concatenate([circle, *rings, [[0, 0, 1], [0, 0, -1]]])


@njit(cache=True)
def compiled_wrenches(
    contacts: np.ndarray,
    normals: np.ndarray,
    origin: np.ndarray,
    scale: float,
    friction: float,
    torsion: float,
    cone: np.ndarray,
) -> np.ndarray:
    """Return wrenches (N, F P, 6) of contacts and normals (N, F, 3) with `cone_edges` (P, 3); see quality.wrenches."""
    edges = len(cone)
    result = np.zeros((contacts.shape[0], contacts.shape[1] * edges, 6))
    for i in range(contacts.shape[0]):
        for f in range(contacts.shape[1]):
            rx = (contacts[i, f, 0] - origin[0]) / scale
            ry = (contacts[i, f, 1] - origin[1]) / scale
            rz = (contacts[i, f, 2] - origin[2]) / scale
            nx, ny, nz = -normals[i, f, 0], -normals[i, f, 1], -normals[i, f, 2]
            if np.isnan(rx + ry + rz + nx + ny + nz):
                continue
            # The axis least along the normal fixes the first tangent.
            if abs(nx) <= abs(ny) and abs(nx) <= abs(nz):
                ax, ay, az = 0.0, nz, -ny
            elif abs(ny) <= abs(nz):
                ax, ay, az = -nz, 0.0, nx
            else:
                ax, ay, az = ny, -nx, 0.0
            size = np.sqrt(ax * ax + ay * ay + az * az)
            if size > 0.0:
                ax, ay, az = ax / size, ay / size, az / size
            bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
            for e in range(edges):
                along, across, turn = friction * cone[e, 0], friction * cone[e, 1], torsion * cone[e, 2] / scale
                fx, fy, fz = nx + along * ax + across * bx, ny + along * ay + across * by, nz + along * az + across * bz
                at = f * edges + e
                result[i, at, 0], result[i, at, 1], result[i, at, 2] = fx, fy, fz
                result[i, at, 3] = ry * fz - rz * fy + turn * nx
                result[i, at, 4] = rz * fx - rx * fz + turn * ny
                result[i, at, 5] = rx * fy - ry * fx + turn * nz
    return result


def differentiable_wrenches(
    contacts: Float[Tensor, "N F 3"],
    normals: Float[Tensor, "N F 3"],
    origin: Float[Tensor, "3"],
    scale: float,
    friction: float,
    torsion: float,
    cone: Float[Tensor, "P 3"],
) -> Float[Tensor, "N FP 6"]:
    """Return the same wrenches on the tensors' device, differentiable with respect to contacts and normals."""
    touched = ~(contacts.isnan().any(-1, keepdim=True) | normals.isnan().any(-1, keepdim=True))
    arm = torch.where(touched, (contacts - origin) / scale, 0.0)
    inward = torch.where(touched, -normals, 0.0)
    axis = torch.nn.functional.one_hot(inward.abs().argmin(-1), 3).to(inward)
    t_x = torch.nn.functional.normalize(torch.linalg.cross(inward, axis), dim=-1)
    t_y = torch.linalg.cross(inward, t_x)
    tangent = cone[:, :1] * t_x.unsqueeze(-2) + cone[:, 1:2] * t_y.unsqueeze(-2)
    force = inward.unsqueeze(-2) + friction * tangent
    turn = (torsion / scale) * cone[:, 2:] * inward.unsqueeze(-2)
    torque = torch.linalg.cross(arm.unsqueeze(-2).expand_as(force), force) + turn
    return torch.cat([force, torque], dim=-1).flatten(-3, -2)
