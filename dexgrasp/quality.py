"""Grasp quality: contact wrenches and the Ferrari-Canny epsilon (METHOD section 5).

Every epsilon is a number about a wrench set; what made the set (torque origin and scale, friction, cone edges, unit
normal force per contact, hull of all cone edges = L1) travels with it as arguments of `wrenches`.
"""

import math

import numpy as np
import torch
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.wrench_hull import DECIDE, SIZE, evaluate

Array = Tensor | np.ndarray


def wrenches(
    contacts: Array, normals: Array, origin: Array, scale: float, friction: float = 0.5, edges: int = 8
) -> Array:
    """Return the cone-edge wrenches (N, F * edges, 6) of point contacts with friction.

    contacts (N, F, 3) in m and normals (N, F, 3), outward and unit, share one frame with origin (3,), about which
    torques are taken. Edge k of a cone is f = n_in + friction (cos(a) t_x + sin(a) t_y), a = 2 pi k / edges: unit
    normal force. A wrench is (f, (p - origin) x f / scale); scale (m) is usually the largest distance from origin to
    the surface. A contact of NaN gives zero wrenches. Ferrari & Canny 1992; differentiable for tensors.
    """
    if scale <= 0 or edges < 3 or friction < 0:
        raise DexgraspError(
            "scale > 0, edges >= 3, friction >= 0", f"{scale=}, {edges=}, {friction=}", "mend the wrench model"
        )
    if isinstance(contacts, np.ndarray):
        return _wrenches(torch.from_numpy(contacts), normals, origin, scale, friction, edges).numpy()
    return _wrenches(contacts, normals, origin, scale, friction, edges)


def _wrenches(contacts: Tensor, normals: Array, origin: Array, scale: float, friction: float, edges: int) -> Tensor:
    normals, origin = torch.as_tensor(normals).to(contacts), torch.as_tensor(origin).to(contacts)
    touched = ~(contacts.isnan().any(-1, keepdim=True) | normals.isnan().any(-1, keepdim=True))
    arm = torch.where(touched, (contacts - origin) / scale, 0.0)
    inward = torch.where(touched, -normals, 0.0)
    # The axis least along the normal fixes the first tangent.
    axis = torch.nn.functional.one_hot(inward.abs().argmin(-1), 3).to(inward)
    t_x = torch.nn.functional.normalize(torch.linalg.cross(inward, axis), dim=-1)
    t_y = torch.linalg.cross(inward, t_x)
    angle = torch.arange(edges).to(contacts) * (2 * math.pi / edges)
    tangent = torch.cos(angle)[:, None] * t_x.unsqueeze(-2) + torch.sin(angle)[:, None] * t_y.unsqueeze(-2)
    force = inward.unsqueeze(-2) + friction * tangent
    torque = torch.linalg.cross(arm.unsqueeze(-2).expand_as(force), force)
    return torch.cat([force, torque], dim=-1).flatten(-3, -2)


def epsilon(wrenches: Array, threshold: float | None = None) -> Array:
    """Return the radius (N,) of the largest ball about the origin inside each hull of wrenches (N, W, 6).

    Exact to 1e-11 for wrenches of order 1; exactly 0 where the origin is not strictly inside or the set spans fewer
    than six dimensions. With a threshold, sets certified to lie below it give 0 at once and the others stay exact.
    """
    return _run(wrenches, -math.inf if threshold is None else threshold, False)


def reaches(wrenches: Array, threshold: float) -> Array:
    """Return whether epsilon >= threshold (> 0) for each set (N, W, 6): the fastest filter, certified both ways."""
    return _run(wrenches, threshold, True) >= threshold


def _run(wrenches: Array, threshold: float, decide: bool) -> Array:
    if wrenches.ndim != 3 or wrenches.shape[-1] != 6:
        raise DexgraspError("wrenches of shape (N, W, 6)", f"shape {tuple(wrenches.shape)}", "stack sets of wrenches")
    if isinstance(wrenches, np.ndarray):
        dense = np.ascontiguousarray(wrenches, dtype=np.float64)
    else:
        dense = np.ascontiguousarray(wrenches.detach().cpu().numpy(), dtype=np.float64)
    if not np.isfinite(dense).all():
        raise DexgraspError("finite wrenches", "NaN or infinity", "give untouched contacts zero wrenches")
    empty = not dense.shape[1]
    result = np.zeros(len(dense)) if empty else evaluate(dense, 0, float(threshold), DECIDE if decide else SIZE)[0]
    return result if isinstance(wrenches, np.ndarray) else torch.from_numpy(result).to(wrenches)
