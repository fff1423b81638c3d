"""What lies about a proposed hand and on the way of its fingers, as a scorer looks at it."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.cells import BITS, Cells, find_cell, make_cells
from dexgrasp.device import takes_compiled
from dexgrasp.execution import closing_direction
from dexgrasp.geometry import transform
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.sampling import farthest_points, morton

COARSE, NEAREST = 512, 64
"""Of so many points, spread evenly over the scene, a grasp is judged by the ones nearest to the middle of its tips."""
FINE = 2048
"""And of so many by the ones nearest to each finger on its way."""
NEAR = 0.08
"""Side of the cells that are looked through first, m: smaller ones often hold too few."""
BLOCK = 32
"""Points that are passed over together where none of them is near."""
REACH, TIP_REACH = 0.1, 0.03
"""Offsets and heights (m) in units of this are numbers of order one; about a fingertip, of the other."""


def coarse_points(cloud: Float[Tensor, "N 6"], count: int = COARSE) -> Float[Tensor, "Q 6"]:
    """Return `count` points that are spread evenly over a cloud (farthest-point samples); more begin with fewer."""
    return cloud[farthest_points(cloud[:, :3], min(count, len(cloud)))]


Seen = tuple[Float[Tensor, "N K 7"], Float[Tensor, "N F S 7"]]
"""What a scorer sees, as `look` returns it: points about the hands, nearest points on the fingers' way."""


def look(
    hand: Hand,
    grasps: Grasps,
    points: Float[Tensor, "Q 6"],
    sweep: Sequence[float] = (),
    along: Sequence[float] = (0.0,),
) -> Seen:
    """Return `surroundings` among the first of a scene's `coarse_points` and `swept` among all of them."""
    return surroundings(hand, grasps, points[:COARSE]), swept(hand, grasps, points, sweep, along)


def surroundings(hand: Hand, grasps: Grasps, points: Float[Tensor, "Q 6"]) -> Float[Tensor, "N K 7"]:
    """Return the `points` about each hand: position and normal in its palm's frame, height in the level one; scaled.

    The K nearest to the middle of its tips, in no particular order.
    """
    points = points.to(grasps.pose)
    tips = hand.fingertips(grasps.joints)
    middle = transform(grasps.pose, tips[..., :3, 3].mean(dim=1).to(grasps.pose))
    palm = grasps.pose @ hand.base_T_palm.to(grasps.pose)
    return _seen(middle, palm, points, NEAREST, REACH)


def swept(
    hand: Hand,
    grasps: Grasps,
    points: Float[Tensor, "Q 6"],
    sweep: Sequence[float],
    along: Sequence[float] = (0.0,),
) -> Float[Tensor, "N F S 7"]:
    """Return the point nearest to each place of a finger on its way, in the fingertip's frame, moved there; scaled.

    Position, normal and height in the level frame.

    Of the told posture, closed further by shares `sweep` of the range of each joint that closes a finger; less than 0
    opens it. Where it ends on what is seen, and how, is then a matter of the few numbers at which a point is near.
    `along` are places on the distal link, shares of the way from the fingertip's centre (0) to the outer joint (1); in
    S all places of the sweep come first with the first, then with the second, ...
    """
    if not sweep:
        return grasps.pose.new_zeros(len(grasps), len(hand.fingers), 0, 7)
    places = len(along) * len(sweep)
    lower, upper = hand.limits.to(grasps.joints).unbind(1)
    step = closing_direction(hand).to(grasps.joints) * (upper - lower)
    joints = grasps.joints[:, None] + torch.tensor(sweep).to(grasps.joints)[:, None] * step
    tips = hand.fingertips(hand.clamp(joints.flatten(0, 1))).to(grasps.pose).unflatten(0, (-1, len(sweep)))
    tips = (grasps.pose[:, None, None] @ tips.transpose(1, 2)).unsqueeze(2).repeat(1, 1, len(along), 1, 1, 1)
    inward = torch.tensor([[share * finger.reach for share in along] for finger in hand.fingers]).to(tips)
    tips[..., :3, 3] += inward[:, :, None, None] * tips[..., :3, 0]
    every = tips.flatten(0, 3)  # place after place of one finger
    nearest = _seen(every[:, :3, 3], every, points.to(every), 1, TIP_REACH)
    return nearest.reshape(len(grasps), len(hand.fingers), places, 7)


def _seen(
    middle: Float[Tensor, "N 3"], frame: Float[Tensor, "N 4 4"], points: Float[Tensor, "Q 6"], count: int, reach: float
) -> Float[Tensor, "N K 7"]:
    count = min(count, len(points))
    quick = takes_compiled(frame) and not frame.requires_grad
    return (_compiled if quick else around_reference)(middle, frame, points, count, reach)


def around_reference(
    middle: Float[Tensor, "N 3"],
    frame: Float[Tensor, "N 4 4"],
    points: Float[Tensor, "Q 6"],
    count: int,
    reach: float = REACH,
) -> Float[Tensor, "N K 7"]:
    """Return the `count` points nearest to each `middle`, in a frame of each and over `reach` (m), in plain torch."""
    apart = middle[:, None] - points[:, :3]
    nearest = apart.square().sum(dim=-1).topk(count, largest=False).indices
    positions, normals = points[nearest].split(3, dim=-1)
    local = (positions - frame[:, None, :3, 3]) @ frame[:, :3, :3] / reach
    return torch.cat([local, normals @ frame[:, :3, :3], positions[..., 2:] / reach], dim=-1)


def _compiled(
    middle: Float[Tensor, "N 3"], frame: Float[Tensor, "N 4 4"], points: Float[Tensor, "Q 6"], count: int, reach: float
) -> Float[Tensor, "N K 7"]:
    out = torch.empty(len(middle), count, 7)
    one, other, third = (part.detach().contiguous().numpy() for part in (middle, frame, points))
    if count == 1:
        order = np.argsort(morton(np.ascontiguousarray(third[:, :3])), kind="stable")
        _closest(one, other, third[order], np.float32(1 / reach), out.numpy())
        return out
    cells = make_cells(third[:, :3], NEAR)
    _around(one, other, third[cells.order], cells, np.float32(1 / reach), out.numpy())
    return out


@njit(cache=True)
def _around(
    middle: np.ndarray, frame: np.ndarray, points: np.ndarray, cells: Cells, scale: np.float32, out: np.ndarray
) -> None:
    """Fill `out` from points in the order of the cells: those about each place, or all where these hold too few."""
    cells, points, frame = borrowed(cells), borrowed(points), borrowed(frame)
    count, total = out.shape[1], len(points)
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    apart, row, last = np.empty(total, np.float32), np.empty(total, np.int64), np.float32(1e-3)
    low, side = cells.low, cells.side
    reach = np.float32(side * side)
    for i in range(len(middle)):
        a, b, c = middle[i]
        u, v, w = int((a - low[0]) / side) + 1, int((b - low[1]) / side) + 1, int((c - low[2]) / side) + 1
        some = 0
        for p in range(u - 1, u + 2):
            for q in range(v - 1, v + 2):
                for s in range(w - 1, w + 2):
                    key = (p << 2 * BITS) | (q << BITS) | s
                    slot = find_cell(cells.keys, key)
                    if cells.keys[slot] == key:
                        start = cells.starts[slot]
                        for n in range(cells.stops[slot] - start):
                            row[some + n] = start + n
                            e, f, g = x[start + n] - a, y[start + n] - b, z[start + n] - c
                            apart[some + n] = e * e + f * f + g * g
                        some += cells.stops[slot] - start
        inside = 0
        for k in range(some):
            inside += apart[k] <= reach
        if inside < count:  # something nearer may lie in other cells
            some = total
            for k in range(total):
                row[k] = k
                e, f, g = x[k] - a, y[k] - b, z[k] - c
                apart[k] = e * e + f * f + g * g
        last = _copy_nearest(apart[:some], row, points, frame[i], last, scale, out[i])


@njit(cache=True)
def _closest(middle: np.ndarray, frame: np.ndarray, points: np.ndarray, scale: np.float32, out: np.ndarray) -> None:
    """Fill `out` (N, 1, 7) from points in the order of a curve that fills space.

    Blocks of them are passed over that lie farther off than the point which was nearest to the place before.
    """
    middle, frame, points, out = borrowed(middle), borrowed(frame), borrowed(points), borrowed(out)
    total = len(points)
    blocks = (total + BLOCK - 1) // BLOCK
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    low, high = np.empty((3, blocks), np.float32), np.empty((3, blocks), np.float32)
    for block in range(blocks):
        for axis in range(3):
            part = points[block * BLOCK : (block + 1) * BLOCK, axis]
            low[axis, block], high[axis, block] = part.min(), part.max()
    away, apart = np.empty(blocks, np.float32), np.empty(BLOCK, np.float32)
    best, zero = 0, np.float32(0)
    for i in range(len(middle)):
        a, b, c = middle[i]
        for k in range(blocks):
            u = max(low[0, k] - a, a - high[0, k], zero)
            v = max(low[1, k] - b, b - high[1, k], zero)
            w = max(low[2, k] - c, c - high[2, k], zero)
            away[k] = u * u + v * v + w * w
        limit = (x[best] - a) ** 2 + (y[best] - b) ** 2 + (z[best] - c) ** 2
        for k in range(blocks):
            if away[k] >= limit:
                continue
            start, count = k * BLOCK, min(BLOCK, total - k * BLOCK)
            for n in range(count):
                u, v, w = x[start + n] - a, y[start + n] - b, z[start + n] - c
                apart[n] = u * u + v * v + w * w
            for n in range(count):
                if apart[n] < limit:
                    limit, best = apart[n], start + n
        _write(points[best], frame[i], scale, out[i, 0])


@njit(cache=True)
def _copy_nearest(
    apart: np.ndarray,
    row: np.ndarray,
    points: np.ndarray,
    frame: np.ndarray,
    last: np.float32,
    scale: np.float32,
    out: np.ndarray,
) -> np.float32:
    """Fill `out` (K, 7) with the K rows that are least far `apart`; return how far the last one is, squared.

    Counting is quick, and a few guesses of the limit within which K lie are enough: that of the place before (`last`),
    then as if points lay on a plane, and the middle where that does not lead on.
    """
    count, total = len(out), len(apart)
    zero, half, top = np.float32(0), np.float32(0.5), np.float32(np.inf)
    below, limit, inside, guess, turns = np.float32(-1), top, total, last, 0
    while inside != count:
        if not (below < guess < limit):
            guess = half * (max(below, zero) + limit)
            if not (below < guess < limit):
                break  # neighbouring numbers: several points lie at the very limit
        found = 0
        for k in range(total):
            found += apart[k] <= guess
        if found < count:
            below = guess
        else:
            limit, inside = guess, found
        turns += 1
        if limit == top:
            guess = np.float32(4) * guess
        elif turns < 8:
            guess = limit * np.float32(count + 0.5) / np.float32(inside + 0.5)
        else:
            guess = half * (max(below, zero) + limit)
    room = count  # for points at the very limit: as many as nearer ones leave
    for k in range(total):
        room -= apart[k] < limit
    n = 0
    for start in range(0, total, BLOCK):
        stop, some = min(start + BLOCK, total), 0
        for k in range(start, stop):
            some += apart[k] <= limit
        if some == 0:
            continue
        for k in range(start, stop):
            if not apart[k] <= limit or (apart[k] == limit and room == 0) or n == count:
                continue
            room -= apart[k] == limit
            _write(points[row[k]], frame, scale, out[n])
            n += 1
    out[n:] = np.nan  # of a place that is none
    return limit if zero < limit < top else last


@njit(cache=True, inline="always")
def _write(point: np.ndarray, frame: np.ndarray, scale: np.float32, out: np.ndarray) -> None:
    """Fill `out` (7,) with position and normal of a point (6,) in a frame (4, 4), and its height."""
    x, y, z = point[0] - frame[0, 3], point[1] - frame[1, 3], point[2] - frame[2, 3]
    for axis in range(3):
        a, b, c = frame[0, axis], frame[1, axis], frame[2, axis]
        out[axis] = (x * a + y * b + z * c) * scale
        out[3 + axis] = point[3] * a + point[4] * b + point[5] * c
    out[6] = point[2] * scale
