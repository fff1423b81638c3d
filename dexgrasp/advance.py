"""Conservative advancement: a finger moves on the way that it closes, as far as it surely touches nothing."""

from typing import NamedTuple

import numpy as np
from numba import njit

from dexgrasp.distance import Field, interpolated, quick_bound, seed_at
from dexgrasp.hand_body import HandBody, carry, place_link
from dexgrasp.patch_distance import SCRATCH, move_patch, patch_time
from dexgrasp.triangle_tree import TriangleTree, nearest

TOUCH = 4.5e-5
"""A finger touches where the gap is at most this, m."""
SPARE = 5e-6
"""Steps leave this much, m: links must not stop in the surface itself, where rounding decides."""
NEAR = 0.7
"""A bounding ball is split once the surface is nearer than this many times what splitting may gain."""
CLOSE = 3e-4
"""Below this the grid's lower bound gives way to distances to triangles, m."""
FAR = 3e-3
"""Of distances from a ball to the surface above this the grid's quickest bound will do, m."""
APART = 1e-5
"""Which side of the surface a normal points to is told this far from it, m."""
REACH = 5e-3
"""Triangles farther than this from a link are not looked at, m."""
AHEAD = 1.0
"""What is due within this part of the last step is looked at early."""


class Scratch(NamedTuple):
    """What `advance` works in."""

    due: np.ndarray
    nodes: np.ndarray
    chain: np.ndarray
    twists: np.ndarray
    """(L, 6) angular velocity, and the velocity of what is at the object's origin."""
    moved: np.ndarray
    work: np.ndarray


@njit(cache=True)
def advance_scratch(body: HandBody) -> Scratch:
    """Return arrays for `advance` to work in."""
    nodes, links, spans = len(body.cover.balls), len(body.parents), body.cover.spans
    return Scratch(
        np.empty(nodes),
        np.empty(nodes, np.int64),
        np.empty(links, np.int64),
        np.zeros((links, 6)),
        np.empty((3, (spans[1:] - spans[:-1]).max())),
        np.empty(SCRATCH),
    )


@njit(cache=True, error_model="numpy")
def advance(
    body: HandBody,
    field: Field,
    base: np.ndarray,
    finger: int,
    rate: np.ndarray,
    full: np.ndarray,
    poses: np.ndarray,
    free: np.ndarray,
    ways: np.ndarray,
    scratch: Scratch,
    hit: np.ndarray,
) -> int:
    """Move joints at `rate` from `full` until a link touches; return it, or -1 at the limits.

    `full` and `poses` end at that posture; `hit` is the touch: distance, point and normal; links that moved without
    an overlap are `free`. Every waiting node of the covering trees holds the time before which nothing below it can
    touch: its distance over its largest speed. `ways` (P, 3) are the directions along which each part was apart from
    the object last, or 0.
    """
    due, nodes, chain, twists, moved, work = scratch
    cover, motions, limits, tree = body.cover, body.motions, body.limits, field.tree
    balls, children, gains, owners, roots = cover.balls, cover.children, cover.gains, cover.links, cover.roots
    points, spans, patch_balls, parts = cover.points, cover.spans, cover.patch_balls, cover.parts
    speeds, patch_speeds, bends = cover.speeds[finger], cover.patch_speeds[finger], cover.bends[finger]
    boxes, skips, firsts, corners, normals = tree
    values, spacing = field.values, field.spacing
    left, below, behind = field.origin
    start, end = full.copy(), 0.0
    for m in range(len(rate)):
        if rate[m] != 0:
            limit = limits[m, 1] if rate[m] > 0 else limits[m, 0]
            end = max(end, (limit - start[m]) / rate[m])
    moving, links, size = np.zeros(len(motions), np.bool_), 0, 0
    for link in range(len(motions)):
        parent, drive = int(motions[link, 0]), int(motions[link, 2])
        moving[link] = (parent >= 0 and moving[parent]) or (drive >= 0 and rate[drive] != 0)
        if moving[link]:
            chain[links] = link
            links += 1
            if roots[link] >= 0:
                due[size], nodes[size] = 0.0, roots[link]
                size += 1
    placed, turned, time, pause = -1.0, -1.0, 0.0, 0.0
    while size:
        # What is due soon is looked at now: placing links costs more.
        horizon = time + (AHEAD * (time - placed) if placed >= 0 else 0.0)
        if time > placed:
            _place(motions, limits, base, chain[:links], start, rate, time, full, poses)
            placed = time
        k, soonest = 0, np.inf
        while k < size:
            if due[k] > horizon:
                soonest = min(soonest, due[k])
                k += 1
                continue
            node = nodes[k]
            link = owners[node]
            x, y, z = carry(poses, link, balls, node)
            radius = balls[node, 3]
            gap = quick_bound(values, boxes, left, below, behind, spacing, x, y, z, radius + FAR) - radius
            if children[node, 0] >= 0 and gap <= NEAR * gains[node]:
                nodes[k], nodes[size], due[size] = children[node, 0], children[node, 1], due[k]
                size += 1
                continue
            wait = (gap - SPARE) / speeds[node]
            if gap < CLOSE and children[node, 0] < 0:
                if due[k] > time:  # a patch is not looked at before it must
                    soonest = min(soonest, due[k])
                    k += 1
                    continue
                if time == 0 and interpolated(field, x, y, z) < spacing:
                    nearest(tree, x, y, z, seed_at(field, x, y, z), hit)
                    if hit[0] < 0:  # the link starts inside the object
                        return link
                if turned < time:
                    pause = _turn(motions, limits, chain[:links], start, rate, time, poses, twists)
                    turned = time
                x, y, z = carry(poses, link, patch_balls, node)
                way = ways[parts[node]]
                seed = seed_at(field, x, y, z)
                if way[0] == 0 and way[1] == 0 and way[2] == 0:
                    for i in range(3):
                        way[i] = -normals[seed, 0, i]
                first, last = spans[node], spans[node + 1]
                speed = move_patch(points, first, last, poses[link], twists[link], moved)
                clear = patch_time(
                    moved, last - first, boxes, skips, firsts, corners, normals, twists[link], way, seed,
                    x, y, z, patch_balls[node, 3], speed, bends[node],
                    min(min(pause, end) - time, REACH / patch_speeds[node]), TOUCH, SPARE, work, hit,
                )  # fmt: skip
                if clear < 0:
                    if time == 0:
                        _face_outwards(tree, seed, hit)
                    for c in range(links):
                        free[chain[c]] |= time > 0
                    return link
                wait = np.inf if clear == end - time else max(wait, clear)
            due[k] = time + wait
            if due[k] <= end:
                soonest = min(soonest, due[k])
                k += 1
            else:  # not on this way
                size -= 1
                due[k], nodes[k] = due[size], nodes[size]
        time = soonest
    _place(motions, limits, base, chain[:links], start, rate, end, full, poses)
    for c in range(links):
        free[chain[c]] = True
    return -1


@njit(cache=True, error_model="numpy")
def _face_outwards(tree: TriangleTree, seed: int, hit: np.ndarray) -> None:
    """Turn the normal of a touch round where a patch that starts inside the object touches it from there."""
    probe = np.empty(7)
    nearest(tree, hit[1] + APART * hit[4], hit[2] + APART * hit[5], hit[3] + APART * hit[6], seed, probe)
    if probe[0] < 0:
        for i in range(4, 7):
            hit[i] = -hit[i]


@njit(cache=True, error_model="numpy")
def _place(
    motions: np.ndarray,
    limits: np.ndarray,
    base: np.ndarray,
    chain: np.ndarray,
    start: np.ndarray,
    rate: np.ndarray,
    time: float,
    full: np.ndarray,
    poses: np.ndarray,
) -> None:
    for m in range(len(full)):
        if rate[m] != 0:
            full[m] = min(max(start[m] + rate[m] * time, limits[m, 0]), limits[m, 1])
    for k in range(len(chain)):
        place_link(motions, chain[k], full, base, poses)


@njit(cache=True, error_model="numpy")
def _turn(
    motions: np.ndarray,
    limits: np.ndarray,
    chain: np.ndarray,
    start: np.ndarray,
    rate: np.ndarray,
    time: float,
    poses: np.ndarray,
    twists: np.ndarray,
) -> float:
    """Write the twists (L, 6) of the links that move; return the time until which joints keep their speeds."""
    pause = np.inf
    for k in range(len(chain)):
        link = chain[k]
        parent, kind, drive = int(motions[link, 0]), int(motions[link, 1]), int(motions[link, 2])
        twist, pose = twists[link], poses[link]
        twist[:] = 0.0
        if k and parent >= 0:
            for above in range(k):
                if chain[above] == parent:
                    twist[:] = twists[parent]
        if not kind or rate[drive] == 0:
            continue
        stop = (limits[drive, 1 if rate[drive] > 0 else 0] - start[drive]) / rate[drive]
        if stop <= time:
            continue
        pause = min(pause, stop)
        x, y, z = motions[link, 3], motions[link, 4], motions[link, 5]
        a = rate[drive] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z)
        b = rate[drive] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z)
        c = rate[drive] * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z)
        if kind == 1:
            twist[0] += a
            twist[1] += b
            twist[2] += c
            twist[3] += pose[1, 3] * c - pose[2, 3] * b
            twist[4] += pose[2, 3] * a - pose[0, 3] * c
            twist[5] += pose[0, 3] * b - pose[1, 3] * a
        else:
            twist[3] += a
            twist[4] += b
            twist[5] += c
    return pause
