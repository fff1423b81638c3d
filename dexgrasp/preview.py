"""A quick look ahead: where would the fingertips touch if this hand closed?

Each finger is only its fingertip circle, a ball here, that follows the closing motion through the distance grid. What
the look promises is nearly what closing finds, at a twentieth of the time; what it rejects rarely closes.
"""

import math

import numpy as np
import torch
from numba import njit

from dexgrasp.borrow import borrowed
from dexgrasp.distance import DistanceField, Field, trilinear
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_links

COARSENESS = 8.0
"""The open hand is looked at with balls that follow it this much less closely than closing does."""
NEAR = 5e-4
"""A fingertip touches where the grid says that it is this near, m."""
HASTE = 1.5
"""Steps are this much longer than the distance allows for certain: what is overshot is gone back."""
STEPS = 64
"""Steps of a fingertip along its way, at most; those that slide along a surface are given up."""
PROBES = 2048
"""Postures from which the largest speed of a fingertip is told."""

SEEN, BURIED, MISSED = range(3)
"""How a look ended."""


class Preview:
    """Looks at hands that are to close on an object."""

    def __init__(self, hand: Hand) -> None:
        self.body = hand_body(hand, COARSENESS)
        self.chains = _chains(self.body)
        self.speeds = _tip_speeds(hand, self.body)

    def look(
        self,
        field: DistanceField,
        bases: np.ndarray,
        joints: np.ndarray,
        limit: float,
        touching: np.ndarray | None = None,
        least: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Look at hands object_T_base (N, 3, 4) with open fingers at joints (N, J).

        Returns how each look ended (N,): SEEN, BURIED where the open hand is deeper than `limit` (m) in the object,
        MISSED where fewer than `least` (None: all) of the fingertips that are `touching` (N, F; None: all) meet it; the
        full joints (N, M) where the fingertips meet the object; and contact points and outward normals (N, F, 6)
        there, object frame (m). Fingers that miss, or are not to touch, stay open, and their contacts are NaN.
        """
        shape = len(bases), len(self.chains)
        chosen = np.ones(shape, np.bool_) if touching is None else np.ascontiguousarray(touching)
        spare = np.zeros(len(bases), np.int64) if least is None else chosen.sum(axis=1) - least
        return _look(self.body, field.field, bases, joints, chosen, spare, self.chains, self.speeds, limit)


def _chains(body: HandBody) -> np.ndarray:
    """Return (F, L) the links that move when a finger closes, from base to fingertip; -1 where there are fewer."""
    found = []
    for finger, rate in enumerate(body.rates @ body.coupling.T):
        link, way = int(body.tip_links[finger]), []
        while link >= 0:
            way.append(link)
            link = int(body.parents[link])
        way.reverse()
        moving = [body.drives[link] >= 0 and rate[body.drives[link]] != 0 for link in way]
        first = moving.index(True) if any(moving) else len(way)
        found.append(way[first:])
    width = max(map(len, found))
    return np.array([way + [-1] * (width - len(way)) for way in found], dtype=np.int64)


def _tip_speeds(hand: Hand, body: HandBody) -> np.ndarray:
    """Return the largest speed (F,) of each fingertip's centre per unit of its closing parameter."""
    generator = torch.Generator().manual_seed(0)
    low, high = hand.limits.T
    joints = low + (high - low) * torch.rand(PROBES, len(low), generator=generator, dtype=torch.float64)
    here, step = hand.fingertips(joints)[..., :3, 3], 1e-5
    speeds = []
    for finger, rate in enumerate(torch.from_numpy(body.rates)):
        there = hand.fingertips(joints + step * rate)[:, finger, :3, 3]
        speeds.append(1.05 * float((there - here[:, finger]).norm(dim=1).max()) / step)
    return np.array(speeds)


@njit(cache=True, error_model="numpy")
def _distance(grid: np.ndarray, frame: np.ndarray, x: float, y: float, z: float) -> float:
    """Return about the signed distance at a point (m); `frame` holds the object's box, then the grid's origin, spacing.

    Not by a `Field`: small functions that take a whole one spend most of their time counting references to its arrays.
    """
    return trilinear(grid, frame, frame[1, 0], frame[1, 1], frame[1, 2], frame[1, 3], x, y, z)


@njit(cache=True, error_model="numpy")
def _buried(
    balls: np.ndarray,
    children: np.ndarray,
    roots: np.ndarray,
    grid: np.ndarray,
    frame: np.ndarray,
    poses: np.ndarray,
    limit: float,
    stack: np.ndarray,
) -> bool:
    for link in range(len(roots)):
        if roots[link] < 0:
            continue
        stack[0] = roots[link]
        top = 1
        while top:
            top -= 1
            node = stack[top]
            x, y, z = carry(poses, link, balls, node)
            if _distance(grid, frame, x, y, z) >= balls[node, 3] - limit:
                continue
            if children[node, 0] < 0:
                return True
            stack[top], stack[top + 1] = children[node, 0], children[node, 1]
            top += 2
    return False


@njit(cache=True, error_model="numpy")
def _tip(motions: np.ndarray, chain: np.ndarray, center: np.ndarray, full: np.ndarray, tip: np.ndarray) -> None:
    """Write the fingertip centre in the frame of the first moving link's parent: a point needs no link poses."""
    x, y, z = center[0], center[1], center[2]
    for c in range(len(chain) - 1, -1, -1):
        if chain[c] < 0:
            continue
        m = chain[c]
        kind = int(motions[m, 1])
        if kind:
            q, a, b, d = full[int(motions[m, 2])], motions[m, 3], motions[m, 4], motions[m, 5]
            if kind == 1:
                sine, cosine = math.sin(q), math.cos(q)
                along = (1 - cosine) * (a * x + b * y + d * z)
                x, y, z = (
                    cosine * x + sine * (b * z - d * y) + along * a,
                    cosine * y + sine * (d * x - a * z) + along * b,
                    cosine * z + sine * (a * y - b * x) + along * d,
                )
            else:
                x, y, z = x + q * a, y + q * b, z + q * d
        x, y, z = (
            motions[m, 6] * x + motions[m, 7] * y + motions[m, 8] * z + motions[m, 9],
            motions[m, 10] * x + motions[m, 11] * y + motions[m, 12] * z + motions[m, 13],
            motions[m, 14] * x + motions[m, 15] * y + motions[m, 16] * z + motions[m, 17],
        )
    tip[0], tip[1], tip[2] = x, y, z


@njit(cache=True, error_model="numpy")
def _trace(
    motions: np.ndarray,
    chain: np.ndarray,
    center: np.ndarray,
    limits: np.ndarray,
    grid: np.ndarray,
    frame: np.ndarray,
    parent: np.ndarray,
    rate: np.ndarray,
    start: np.ndarray,
    speed: float,
    full: np.ndarray,
    tip: np.ndarray,
) -> bool:
    """Move a fingertip until it touches; return whether it does. `full` and `tip` end there."""
    end = 0.0
    for m in range(len(rate)):
        full[m] = start[m]
        if rate[m] != 0:
            bound = limits[m, 1] if rate[m] > 0 else limits[m, 0]
            end = max(end, (bound - start[m]) / rate[m])
    time = 0.0
    for _ in range(STEPS):
        _tip(motions, chain, center, full, tip)
        x, y, z = tip[0], tip[1], tip[2]
        for k in range(3):
            tip[k] = parent[k, 0] * x + parent[k, 1] * y + parent[k, 2] * z + parent[k, 3]
        gap = _distance(grid, frame, tip[0], tip[1], tip[2]) - center[6]
        if abs(gap) < NEAR:
            return True
        time += (HASTE if gap > 0 else 1.0) * gap / speed
        if time > end or time < 0:
            return False
        for m in range(len(rate)):
            if rate[m] != 0:
                full[m] = min(max(start[m] + rate[m] * time, limits[m, 0]), limits[m, 1])
    return False


@njit(cache=True, error_model="numpy")
def _foot(grid: np.ndarray, frame: np.ndarray, at: np.ndarray, touch: np.ndarray) -> None:
    """Write the surface point below `at` and its normal, as the grid's slope tells them."""
    x, y, z = at[0], at[1], at[2]
    h = 0.5 * frame[1, 3]
    u = _distance(grid, frame, x + h, y, z) - _distance(grid, frame, x - h, y, z)
    v = _distance(grid, frame, x, y + h, z) - _distance(grid, frame, x, y - h, z)
    w = _distance(grid, frame, x, y, z + h) - _distance(grid, frame, x, y, z - h)
    size = math.sqrt(u * u + v * v + w * w) + 1e-12
    gap = _distance(grid, frame, x, y, z)
    touch[3], touch[4], touch[5] = u / size, v / size, w / size
    for k in range(3):
        touch[k] = at[k] - gap * touch[3 + k]


@njit(cache=True)
def _look(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    chosen: np.ndarray,
    spare: np.ndarray,
    chains: np.ndarray,
    speeds: np.ndarray,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    grid, frame = field.values, np.empty((2, 6))
    frame[0], frame[1, :3], frame[1, 3] = field.tree.boxes[0], field.origin, field.spacing
    count, fingers, movable = len(bases), len(body.tip_links), len(body.offset)
    status = np.zeros(count, np.int64)
    closed, touches = np.empty((count, movable)), np.full((count, fingers, 6), np.nan)
    _look_at(
        body, grid, frame, bases, joints, chosen, spare, chains, speeds, limit,
        (status, closed, touches), body.rates @ body.coupling.T,
        (np.empty(movable), np.empty(movable), np.empty((len(body.parents), 3, 4)), np.empty((fingers, 3))),
        np.empty(256, np.int64),
    )  # fmt: skip
    return status, closed, touches


@njit(cache=True)
def _look_at(
    body: HandBody,
    grid: np.ndarray,
    frame: np.ndarray,
    bases: np.ndarray,
    joints: np.ndarray,
    chosen: np.ndarray,
    spare: np.ndarray,
    chains: np.ndarray,
    speeds: np.ndarray,
    limit: float,
    results: tuple[np.ndarray, ...],
    rates: np.ndarray,
    scratch: tuple[np.ndarray, ...],
    stack: np.ndarray,
) -> None:
    body, grid, frame, bases, joints = (
        borrowed(body),
        borrowed(grid),
        borrowed(frame),
        borrowed(bases),
        borrowed(joints),
    )
    chains, rates, stack, chosen = borrowed(chains), borrowed(rates), borrowed(stack), borrowed(chosen)
    status, closed, touches = borrowed(results)
    start, full, poses, tips = borrowed(scratch)
    motions, balls, children, roots, centers = body.motions, body.balls, body.children, body.roots, body.tips
    fingers, movable = len(centers), len(start)
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], start, poses)
        closed[i] = start
        if _buried(balls, children, roots, grid, frame, poses, limit, stack):
            status[i] = BURIED
            continue
        missing = 0
        for finger in range(fingers):
            if not chosen[i, finger]:
                continue
            above = int(motions[chains[finger, 0], 0])
            parent = poses[above] if above >= 0 else bases[i]
            rate, chain, center = rates[finger], chains[finger], centers[finger]
            reached = _trace(
                motions,
                chain,
                center,
                body.limits,
                grid,
                frame,
                parent,
                rate,
                start,
                speeds[finger],
                full,
                tips[finger],
            )
            if not reached:
                missing += 1
                if missing > spare[i]:
                    status[i] = MISSED
                    break
                tips[finger, 0] = np.nan
                continue
            for m in range(movable):
                if rate[m] != 0:
                    closed[i, m] = full[m]
        if status[i] == SEEN:
            for finger in range(fingers):
                if chosen[i, finger] and not np.isnan(tips[finger, 0]):
                    _foot(grid, frame, tips[finger], touches[i, finger])
