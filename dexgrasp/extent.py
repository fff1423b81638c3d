"""The thing at which a grasp is told: where its middle lies from the hand, how far it reaches, and how high."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.connected import connected
from dexgrasp.device import takes_compiled
from dexgrasp.grasps import Grasps
from dexgrasp.segmentation import LOWEST

GAP = 0.02
"""Points of a thing, as thin as `dexgrasp.surroundings.coarse_points` are, lie nearer together than this, m."""
REACH, MANY = 0.1, 200
"""Lengths (m) and numbers of points in units of these are numbers of order one."""
NUMBERS = 11
ROUNDS = 12
"""In plain torch labels pass on so often: nothing waits for them to come to rest, hence a CUDA graph can hold it."""


def extents(grasps: Grasps, at: Float[Tensor, "N 6"], points: Float[Tensor, "Q 6"]) -> Float[Tensor, "N 11"]:
    """Return mean, least and largest coordinates of a thing in the hand's base frame, its height and size; scaled.

    Of what is seen of the thing at which each grasp is told: of those `points` (level frame, m) that hang together with
    the one nearest to `at`, above the table. Zeros where a grasp is told at the table.
    """
    points, at = points.to(grasps.pose), at.to(grasps.pose)
    if not takes_compiled(at) or grasps.pose.requires_grad:
        return extents_reference(grasps.pose, at, points)
    pose, told, where = (part.detach().contiguous().numpy() for part in (grasps.pose, at, points[:, :3]))
    out = torch.empty(len(pose), NUMBERS)
    _extents(pose, told, where, things(where), out.numpy())
    return out


def extents_reference(
    pose: Float[Tensor, "N 4 4"], at: Float[Tensor, "N 6"], points: Float[Tensor, "Q 6"]
) -> Float[Tensor, "N 11"]:
    """Return the same in plain torch."""
    where, thing = points[:, :3], things_reference(points)
    told = thing[(at[:, None, :3] - where).square().sum(dim=2).argmin(dim=1)]
    own = ((thing == told[:, None]) & (told >= 0)[:, None])[..., None]
    local = (where - pose[:, None, :3, 3]) @ pose[:, :3, :3]
    count = own.sum(dim=1).to(pose)
    mean = torch.where(own, local, 0.0).sum(dim=1) / count.clamp(min=1)
    least = torch.where(own, local, torch.inf).amin(dim=1)
    largest = torch.where(own, local, -torch.inf).amax(dim=1)
    height = torch.where(own[..., 0], where[:, 2], -torch.inf).amax(dim=1, keepdim=True)
    lengths = torch.cat([mean, least, largest, height], dim=1) / REACH
    return torch.cat([torch.where(count > 0, lengths, 0.0), count / MANY], dim=1)


def things(points: np.ndarray) -> np.ndarray:
    """Return for each point (Q, 3) the least row of those that it hangs together with; -1 for the table's."""
    thing = np.full(len(points), -1)
    above = np.flatnonzero(points[:, 2] > LOWEST)
    if len(above):
        piece = connected(points[above].astype(np.float64), GAP)
        thing[above] = above[np.unique(piece, return_index=True)[1][piece]]
    return thing


def things_reference(points: Float[Tensor, "Q _"]) -> Int[Tensor, "Q"]:
    """Return the same in plain torch, as far as labels come in `ROUNDS`, which double how far they have come."""
    apart = sum((points[:, None, axis] - points[:, axis]).square() for axis in range(3))
    above = points[:, 2] > LOWEST
    assert isinstance(apart, Tensor)
    near = (apart < GAP**2) & above & above[:, None]
    rows = torch.arange(len(points), device=points.device)
    thing = rows
    for _ in range(ROUNDS):
        least = torch.where(near, thing, len(points)).amin(dim=1).minimum(thing)
        thing = thing.scatter_reduce(0, thing, least, "amin")  # what hangs at a root goes along with it
        thing = thing[thing.minimum(least)]
    return torch.where(above, thing, -1)


@njit(cache=True)
def _extents(pose: np.ndarray, at: np.ndarray, points: np.ndarray, thing: np.ndarray, out: np.ndarray) -> None:
    pose, at, points, thing, out = borrowed(pose), borrowed(at), borrowed(points), borrowed(thing), borrowed(out)
    total = len(points)
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    order = np.argsort(thing, kind="mergesort")
    first, last = np.zeros(total, np.int64), np.zeros(total, np.int64)  # of a thing's points, in that order
    for k in range(total):
        own = thing[order[k]]
        if own >= 0:
            first[own] = k if last[own] == 0 else first[own]
            last[own] = k + 1
    apart = np.empty(total, np.float32)
    for i in range(len(pose)):
        a, b, c = at[i, 0], at[i, 1], at[i, 2]
        for k in range(total):
            e, f, g = x[k] - a, y[k] - b, z[k] - c
            apart[k] = e * e + f * f + g * g
        told = thing[np.argmin(apart)]
        out[i] = 0
        if told < 0:
            continue
        frame, count = pose[i], last[told] - first[told]
        height = -np.float32(np.inf)
        for k in range(first[told], last[told]):
            height = max(height, z[order[k]])
        for axis in range(3):
            u, v, w = frame[0, axis], frame[1, axis], frame[2, axis]
            shift = frame[0, 3] * u + frame[1, 3] * v + frame[2, 3] * w
            mean, least, largest = 0.0, np.float32(np.inf), -np.float32(np.inf)
            for k in range(first[told], last[told]):
                n = order[k]
                along = x[n] * u + y[n] * v + z[n] * w - shift
                mean += along
                least, largest = min(least, along), max(largest, along)
            out[i, axis] = mean / count / REACH
            out[i, 3 + axis] = least / REACH
            out[i, 6 + axis] = largest / REACH
        out[i, 9] = height / REACH
        out[i, 10] = count / MANY
