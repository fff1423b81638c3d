"""Closing a hand's fingers on an object, each until it touches: conservative advancement on the joint angles."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.collision import as_arrays, deepest
from dexgrasp.distal_contact import BLUR, MOST, distal_contact, is_tip
from dexgrasp.distance import DistanceField, Field, interpolated, quick_bound, seed_at
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_link, place_links
from dexgrasp.patch_distance import SCRATCH, patch_time
from dexgrasp.triangle_tree import nearest

TOUCH = 4e-5
"""A finger touches where the gap is at most this, m."""
SPARE = TOUCH / 2
"""Steps leave this much, m: links must not stop in the surface itself, where rounding decides."""
NEAR = 0.5
"""A bounding ball is split once the surface is nearer than this many times what splitting may gain."""
CLOSE = 5e-4
"""Below this the grid's lower bound gives way to distances to triangles, m."""
REACH = 5e-3
"""Triangles farther than this from a link are not looked at, m."""
AHEAD = 1.0
"""What is due within this part of the last step is looked at early."""

CLOSED, PENETRATES, MISSES, OFF_TIP = range(4)
"""How a closing ended. The last three are told only by `close_fingers` with `strict`."""


@dataclass(frozen=True)
class Closure(Batch):
    """N closed hands; object frame."""

    joints: Float[Tensor, "N J"]
    """Independent joints after closing, rad (m where prismatic)."""
    contacts: Float[Tensor, "N F 3"]
    """Point of the object's surface that each finger touches, m; NaN where it touches nothing."""
    normals: Float[Tensor, "N F 3"]
    """Outward unit normal of the object there: from the surface towards the finger."""
    touched: Bool[Tensor, "N F"]
    on_tip: Bool[Tensor, "N F"]
    """Whether the contact lies on the rounded end of the distal link."""
    penetration: Float[Tensor, "N"]
    """Depth of the deepest point of the whole hand in the object at the closed posture, m; 0 for none."""
    full: Float[Tensor, "N M"]
    """All movable joints; after breakaway they need not obey the coupling."""


class Closer:
    """Closes the fingers of one hand along `Finger.closing`.

    A finger stops alone, at its first touch or at its limits; coupled joints follow. Fingers that share a closing
    joint (a parallel jaw) stop together.
    """

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.body: HandBody = hand_body(hand)

    def close(
        self,
        field: DistanceField,
        pose: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        breakaway: bool = False,
    ) -> Closure:
        """Close hands at object_T_base `pose` (m) from the posture `joints`.

        With `breakaway`, links beyond one that touches go on until they touch themselves (BarrettHand's clutch).
        """
        base, start = as_arrays(pose, joints)
        _, full, touches, on_tip, depth = close_fingers(self.body, field.field, base, start, breakaway, False, np.inf)
        touches_t = torch.from_numpy(touches).to(pose)
        return Closure(
            joints=torch.from_numpy(full[:, self.body.leaders]).to(joints),
            contacts=touches_t[..., :3],
            normals=touches_t[..., 3:],
            touched=~touches_t[..., 0].isnan(),
            on_tip=torch.from_numpy(on_tip).to(pose.device),
            penetration=torch.from_numpy(depth).to(pose),
            full=torch.from_numpy(full).to(joints),
        )


@njit(cache=True)
def close_fingers(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    breakaway: bool,
    strict: bool,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Close N hands; return status (N,), full joints (N, M), contact and normal (N, F, 6), on tip (N, F), depth (N,).

    With `strict`, a hand that starts deeper than `limit` (m) in the object, or one of whose fingers misses or does
    not touch with its tip, is given up at once: its status says why and its depth is not measured.
    """
    count, fingers = len(bases), len(body.tip_links)
    status = np.zeros(count, np.int64)
    full = np.zeros((count, len(body.offset)))
    touches = np.full((count, fingers, 6), np.nan)
    on_tip = np.zeros((count, fingers), np.bool_)
    depth = np.zeros(count)
    poses = np.empty((len(body.parents), 3, 4))
    rate, done = np.empty(len(body.offset)), np.zeros(fingers, np.bool_)
    ways, free = (
        np.zeros((len(body.part_links), 3)),
        np.zeros(len(body.parents), np.bool_),
    )
    due, nodes = (
        np.empty(len(body.cover.balls)),
        np.empty(len(body.cover.balls), np.int64),
    )
    twists = np.zeros((len(body.parents), 6))
    chain, work, hit, found = (
        np.empty(len(body.parents), np.int64),
        np.empty(SCRATCH),
        np.empty(7),
        np.empty((MOST, 8)),
    )
    contact = np.empty(7)
    for i in range(count):
        place_links(body, joints[i], bases[i], full[i], poses)
        if strict and deepest(body, field, poses, -limit, True) < -limit:
            status[i] = PENETRATES
            continue
        done[:] = False
        free[:] = False
        ways[:] = 0.0
        for finger in range(fingers):
            if done[finger]:
                continue
            for m in range(len(rate)):
                rate[m] = 0.0
                for j in range(joints.shape[1]):
                    rate[m] += body.coupling[m, j] * body.rates[finger, j]
            touched = _advance(
                body,
                field,
                bases[i],
                finger,
                rate,
                full[i],
                poses,
                due,
                nodes,
                chain,
                free,
                ways,
                twists,
                work,
                hit,
            )
            while breakaway and touched >= 0 and touched != body.tip_links[finger]:
                # The link that touches and all above it stop; what lies beyond goes on.
                link = touched
                while link >= 0:
                    if body.drives[link] >= 0:
                        rate[body.drives[link]] = 0.0
                    link = body.parents[link]
                touched = _advance(
                    body,
                    field,
                    bases[i],
                    finger,
                    rate,
                    full[i],
                    poses,
                    due,
                    nodes,
                    chain,
                    free,
                    ways,
                    twists,
                    work,
                    hit,
                )
            for other in range(finger, fingers):
                shared = other == finger
                for j in range(joints.shape[1]):
                    shared |= body.rates[finger, j] != 0 and body.rates[other, j] != 0
                if not shared or touched < 0:
                    continue
                done[other] = True
                tip = body.tip_links[other]
                if touched == tip or not _above(body.parents, touched, tip):
                    if not distal_contact(body, field, poses, other, touched == tip, nodes, found, contact):
                        continue
                    on_tip[i, other] = is_tip(body, poses, other, contact)
                    touches[i, other] = contact[1:7]
                else:
                    touches[i, other] = hit[1:7]
            if strict and not on_tip[i, finger]:
                status[i] = MISSES if np.isnan(touches[i, finger, 0]) else OFF_TIP
                break
        if not strict:
            depth[i] = _depth(body, field, poses, free, nodes, hit)
    return status, full, touches, on_tip, depth


@njit(cache=True, error_model="numpy")
def _advance(
    body: HandBody,
    field: Field,
    base: np.ndarray,
    finger: int,
    rate: np.ndarray,
    full: np.ndarray,
    poses: np.ndarray,
    due: np.ndarray,
    nodes: np.ndarray,
    chain: np.ndarray,
    free: np.ndarray,
    ways: np.ndarray,
    twists: np.ndarray,
    work: np.ndarray,
    hit: np.ndarray,
) -> int:
    """Move joints at `rate` from `full` until a link touches; return it, or -1 at the limits.

    `full` and `poses` end at that posture; `hit` is the touch: distance, point and normal; links that moved without
    an overlap are `free`. Every waiting node of the
    covering trees holds the time before which nothing below it can touch: its distance over its largest speed.
    """
    cover, motions, limits, shapes, tree = (
        body.cover,
        body.motions,
        body.limits,
        body.shapes,
        field.tree,
    )
    balls, children, gains, owners = (
        cover.balls,
        cover.children,
        cover.gains,
        cover.links,
    )
    speeds, patch_speeds, bends = (
        cover.speeds[finger],
        cover.patch_speeds[finger],
        cover.bends[finger],
    )
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
            if cover.roots[link] >= 0:
                due[size], nodes[size] = 0.0, cover.roots[link]
                size += 1
    placed, time, pause = -1.0, 0.0, 0.0
    while size:
        horizon = time + (
            AHEAD * (time - placed) if placed >= 0 else 0.0
        )  # what is due soon is looked at now: placing links costs more
        if time > placed:
            _place(motions, limits, base, chain[:links], start, rate, time, full, poses)
            pause = _turn(motions, limits, chain[:links], start, rate, time, poses, twists)
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
            gap = quick_bound(field, x, y, z) - balls[node, 3]
            if children[node, 0] >= 0 and gap <= NEAR * gains[node]:
                nodes[k], nodes[size], due[size] = (
                    children[node, 0],
                    children[node, 1],
                    time,
                )
                size += 1
                continue
            wait = (gap - SPARE) / speeds[node]
            if gap < CLOSE and children[node, 0] < 0:
                if time == 0 and interpolated(field, x, y, z) < field.spacing:
                    nearest(tree, x, y, z, seed_at(field, x, y, z), hit)
                    if hit[0] < 0:  # the link starts inside the object
                        return link
                part = cover.parts[node]
                work[7, 0, 0], work[7, 0, 1], work[7, 0, 2] = x, y, z
                way = ways[part]
                seed = seed_at(field, x, y, z)
                if way[0] == 0 and way[1] == 0 and way[2] == 0:
                    for i in range(3):
                        way[i] = -tree.normals[seed, 0, i]
                most, fastest = min(pause, end) - time, patch_speeds[node]
                clear = patch_time(
                    shapes, tree, poses[link], twists[link], part, way, seed, balls[node, 3], fastest, bends[node],
                    min(most, REACH / fastest), TOUCH, SPARE, work, hit,
                )  # fmt: skip
                if clear < 0:
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
        parent, kind, drive = (
            int(motions[link, 0]),
            int(motions[link, 1]),
            int(motions[link, 2]),
        )
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


@njit(cache=True)
def _above(parents: np.ndarray, link: int, below: int) -> bool:
    while below >= 0 and below != link:
        below = parents[below]
    return below == link


@njit(cache=True, error_model="numpy")
def _depth(
    body: HandBody,
    field: Field,
    poses: np.ndarray,
    free: np.ndarray,
    stack: np.ndarray,
    hit: np.ndarray,
) -> float:
    """Return how deep the links that are not known to be free of the object are in it, 0 for none (m)."""
    balls, children, tree = body.balls, body.children, field.tree
    best = 0.0
    for link in range(len(free)):
        if free[link] or body.roots[link] < 0:
            continue
        stack[0], top = body.roots[link], 1
        while top:
            top -= 1
            node = stack[top]
            x, y, z = carry(poses, link, balls, node)
            if quick_bound(field, x, y, z) - balls[node, 3] >= -best:
                continue
            if children[node, 0] >= 0:
                stack[top], stack[top + 1] = children[node, 0], children[node, 1]
                top += 2
            elif interpolated(field, x, y, z) - balls[node, 3] < BLUR - best:
                nearest(tree, x, y, z, seed_at(field, x, y, z), hit)
                best = max(best, balls[node, 3] - hit[0])
    return best
