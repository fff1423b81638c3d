"""Grasp quality of wrench sets: the Ferrari-Canny epsilon and the volume of their hulls (METHOD section 5).

Every such figure is about a wrench set; what made the set (torque origin and scale, friction, torsion, cone edges, unit
normal force per contact, hull) are arguments here and travel with the figure as a `wrench_model.WrenchModel`.
"""

import math

import numpy as np
import torch
from torch import Tensor

from dexgrasp.contact_wrenches import compiled_wrenches, cone_edges, differentiable_wrenches
from dexgrasp.errors import DexgraspError
from dexgrasp.seeds import stream
from dexgrasp.wrench_hull import DECIDE, FACET, SIZE, VOLUME, evaluate

Array = Tensor | np.ndarray
JOGGLE = 1e-9


def wrenches(
    contacts: Array,
    normals: Array,
    origin: Array,
    scale: float,
    friction: float = 0.5,
    edges: int = 8,
    torsion: float = 0.0,
) -> Array:
    """Return the cone-edge wrenches (N, F * P, 6) of point contacts with friction.

    contacts (N, F, 3) in m and normals (N, F, 3), outward and unit, share one frame with origin (3,), about which
    torques are taken. Edge k of a cone is f = n_in + friction (cos(a) t_x + sin(a) t_y), a = 2 pi k / edges: unit
    normal force. A wrench is (f, (p - origin) x f / scale); scale (m) is usually the largest distance from origin to
    the surface. With torsion (m) > 0 contacts are soft fingers: P = 3 edges + 2 wrenches on an ellipsoid instead of
    P = edges, the others with a torque about the normal too (`contact_wrenches.cone_edges`). A contact of NaN gives
    zero wrenches. Ferrari & Canny 1992; differentiable for tensors that require it.
    """
    if not (scale > 0 and edges >= 3 and friction >= 0 and torsion >= 0):
        raise DexgraspError(
            "scale > 0, edges >= 3, friction >= 0, torsion >= 0",
            f"{scale=}, {edges=}, {friction=}, {torsion=}",
            "mend the wrench model",
        )
    cone = cone_edges(edges, torsion > 0)
    tensors = [value for value in (contacts, normals) if isinstance(value, Tensor)]
    if any(value.requires_grad or value.device.type != "cpu" for value in tensors):
        points, outward, about, table = (
            torch.as_tensor(value).to(tensors[0]) for value in (contacts, normals, origin, cone)
        )
        return differentiable_wrenches(points, outward, about, scale, friction, torsion, table)
    dense = [np.ascontiguousarray(value, dtype=np.float64) for value in (contacts, normals, origin)]
    result = compiled_wrenches(dense[0], dense[1], dense[2], float(scale), float(friction), float(torsion), cone)
    return torch.from_numpy(result).to(contacts.dtype) if isinstance(contacts, Tensor) else result


def epsilon(wrenches: Array, threshold: float | None = None, contacts: int = 0) -> Array:
    """Return the radius (N,) of the largest ball about the origin inside each hull of wrenches (N, W, 6).

    Exact to 1e-11 for wrenches of order 1 (1e-10 where seven are coplanar to 1e-12 to 1e-9 only); exactly 0 where the
    origin is not strictly inside or the set spans fewer than six dimensions. With a threshold, sets certified to lie
    below it give 0 at once and the others stay exact.

    The hull is L1, that of all wrenches; with `contacts` > 0, to which the wrenches belong in order and equal parts,
    it is L-infinity: the Minkowski sum over contacts of conv(0, their wrenches), every finger pressing up to 1.
    """
    return _as(wrenches, _evaluate(wrenches, contacts, -math.inf if threshold is None else threshold, SIZE)[0])


def reaches(wrenches: Array, threshold: float, contacts: int = 0) -> Array:
    """Return whether epsilon >= threshold (> 0) for each set (N, W, 6): the fastest filter, certified both ways."""
    return _as(wrenches, _evaluate(wrenches, contacts, threshold, DECIDE)[0]) >= threshold


def volume(wrenches: Array, contacts: int = 0) -> Array:
    """Return the 6-D volume (N,) of each hull of wrenches (N, W, 6); 0 for sets of fewer than six dimensions.

    Exact to 1e-7 of it. For the L1 hull wrenches are moved by up to 1e-9 first, always by the same, so that no seven
    lie on a plane; for L-infinity, those that shall (of one cone) must do so to rounding, as `wrenches` makes them.
    """
    dense = _dense(wrenches, contacts)
    noise = 0.0 if contacts else JOGGLE * stream(0, "joggle").uniform(-1, 1, dense.shape[1:])
    found = _evaluate(dense + noise, contacts, -math.inf, VOLUME)
    spread = dense if contacts else dense - dense.mean(axis=1, keepdims=True)
    full = np.linalg.matrix_rank(spread, tol=10 * JOGGLE) == 6
    return _as(wrenches, np.where(full, found[0], 0.0))


def nearest_facet(wrenches: Array, contacts: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return epsilon (N,), the unit normal (N, 6) of the facet nearest the origin, and its wrenches' numbers (N, 6).

    Numbers are for the L1 hull. Where epsilon is 0, no wrench reaches beyond the origin along the normal, which is
    then one that shows it (zeros for sets of fewer than six dimensions), and the numbers are -1.
    """
    return _evaluate(wrenches, contacts, -math.inf, FACET)


def _evaluate(
    wrenches: Array, contacts: int, threshold: float, wanted: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dense = _dense(wrenches, contacts)
    if not dense.shape[1]:
        return np.zeros(len(dense)), np.zeros((len(dense), 6)), np.full((len(dense), 6), -1)
    found = evaluate(dense, int(contacts), float(threshold), wanted)
    if np.isnan(found[0]).any():
        raise DexgraspError(
            "wrenches of order 1",
            f"set {int(np.isnan(found[0]).argmax())} too near to degenerate for its size",
            "scale torques by the object's radius, forces by the normal force",
        )
    return found


def _dense(wrenches: Array, contacts: int) -> np.ndarray:
    if wrenches.ndim != 3 or wrenches.shape[-1] != 6:
        raise DexgraspError("wrenches of shape (N, W, 6)", f"shape {tuple(wrenches.shape)}", "stack sets of wrenches")
    if contacts < 0 or (contacts and wrenches.shape[1] % contacts):
        raise DexgraspError(
            "as many wrenches from every contact", f"{wrenches.shape[1]} wrenches of {contacts} contacts", "count again"
        )
    if isinstance(wrenches, Tensor):
        wrenches = wrenches.detach().cpu().numpy()
    dense = np.ascontiguousarray(wrenches, dtype=np.float64)
    if not np.isfinite(dense).all():
        raise DexgraspError("finite wrenches", "NaN or infinity", "give untouched contacts zero wrenches")
    return dense


def _as(given: Array, result: np.ndarray) -> Array:
    return result if isinstance(given, np.ndarray) else torch.from_numpy(result).to(given)
