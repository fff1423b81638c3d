"""Closing a hand's fingers on an object, each until it touches: conservative advancement on the joint angles."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.collision import as_arrays, deepest
from dexgrasp.distance import DistanceField, Field, estimate, lower_bound, seed_at
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_link, place_links
from dexgrasp.triangle_tree import nearest

TOUCH = 2e-5
"""A finger touches where the gap is at most this, m."""
TIE = 1e-12
"""Squared distances that differ by less are equal, m2."""
FLAT = 1e-4
"""Balls within this of the surface at the moment of touch belong to the same contact, m."""
NEAR = 0.5
"""A bounding ball is split once the surface is nearer than this many times what splitting may gain."""
CLOSE = 1e-3
"""Below this the grid's lower bound gives way to distances to triangles, m."""
GRID = 4e-3
"""Twice what the grid's lower bound may lack, m."""
DOUBT = 5e-5
"""Allowance for triangles that a cell does not name, m; nearer than twice this the exact distance decides."""
TIP_REACH = 1.25
"""The rounded end reaches this many radii about the fingertip circle's centre, in the finger's side view."""

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
    body: HandBody, field: Field, bases: np.ndarray, joints: np.ndarray, breakaway: bool, strict: bool, limit: float
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
    keys, nodes = np.empty(len(body.balls)), np.empty(len(body.balls), np.int64)
    hit = np.empty(7)
    for i in range(count):
        place_links(body, joints[i], bases[i], full[i], poses)
        if strict and deepest(body, field, poses, -limit, True) < -limit:
            status[i] = PENETRATES
            continue
        done[:] = False
        for finger in range(fingers):
            if done[finger]:
                continue
            for m in range(len(rate)):
                rate[m] = 0.0
                for j in range(joints.shape[1]):
                    rate[m] += body.coupling[m, j] * body.rates[finger, j]
            ball = _advance(body, field, bases[i], finger, rate, full[i], poses, keys, nodes, hit)
            while breakaway and ball >= 0 and body.ball_links[ball] != body.tip_links[finger]:
                # The link that touches and all above it stop; what lies beyond goes on.
                link = body.ball_links[ball]
                while link >= 0:
                    if body.drives[link] >= 0:
                        rate[body.drives[link]] = 0.0
                    link = body.parents[link]
                ball = _advance(body, field, bases[i], finger, rate, full[i], poses, keys, nodes, hit)
            for other in range(finger, fingers):
                shared = other == finger
                for j in range(joints.shape[1]):
                    shared |= body.rates[finger, j] != 0 and body.rates[other, j] != 0
                if not shared or ball < 0:
                    continue
                done[other] = True
                link = body.ball_links[ball]
                if other != finger or link == body.tip_links[finger]:
                    link = body.tip_links[other]
                    if not _settle(body, field, poses, other, nodes, hit):
                        continue
                    on_tip[i, other] = _is_tip(body, poses, other, hit)
                touches[i, other] = hit[1:7]
            if strict and not on_tip[i, finger]:
                status[i] = MISSES if np.isnan(touches[i, finger, 0]) else OFF_TIP
                break
        if not strict:
            depth[i] = max(0.0, -deepest(body, field, poses, 0.0, False))
    return status, full, touches, on_tip, depth


@njit(cache=True)
def _advance(
    body: HandBody,
    field: Field,
    base: np.ndarray,
    finger: int,
    rate: np.ndarray,
    full: np.ndarray,
    poses: np.ndarray,
    keys: np.ndarray,
    nodes: np.ndarray,
    hit: np.ndarray,
) -> int:
    """Move joints at `rate` from `full` until a ball touches; return it, or -1 at the limits.

    `full` and `poses` end at that posture; `hit` is the touch as `nearest` tells it. Every waiting node of the ball
    trees holds the time before which it cannot touch: its distance over the largest speed of its centre.
    """
    start = full.copy()
    end = 0.0
    for m in range(len(rate)):
        if rate[m] != 0:
            limit = body.limits[m, 1] if rate[m] > 0 else body.limits[m, 0]
            end = max(end, (limit - start[m]) / rate[m])
    links = len(body.parents)
    moving = np.zeros(links, np.bool_)
    size = 0
    for link in range(links):
        parent = body.parents[link]
        moving[link] = (parent >= 0 and moving[parent]) or (body.drives[link] >= 0 and rate[body.drives[link]] != 0)
        if moving[link] and body.roots[link] >= 0:
            size = _push(keys, nodes, size, 0.0, body.roots[link])
    placed = 0.0
    while size:
        time, node = keys[0], nodes[0]
        if time > end:
            break
        if time > placed:
            _place(body, base, start, rate, time, moving, full, poses)
            placed = time
        link = body.ball_links[node]
        x, y, z = carry(poses, link, body.balls, node)
        radius = body.balls[node, 3]
        gap = lower_bound(field, x, y, z) - radius
        left = body.children[node, 0]
        if left >= 0:
            if gap > NEAR * body.excess[node]:
                size = _replace(keys, nodes, size, time + gap / body.speeds[finger, node], node)
            else:
                size = _replace(keys, nodes, size, time, left)
                size = _push(keys, nodes, size, time, body.children[node, 1])
            continue
        if gap < CLOSE:
            about = estimate(field, x, y, z) - radius if gap + radius > 0 else 0.0
            if about > 2 * DOUBT:
                gap = max(gap, about - DOUBT)
            else:
                nearest(field.tree, x, y, z, seed_at(field, x, y, z), hit)
                gap = hit[0] - radius
                if gap <= TOUCH:
                    return node
        size = _replace(keys, nodes, size, time + gap / body.speeds[finger, node], node)
    _place(body, base, start, rate, end, moving, full, poses)
    return -1


@njit(cache=True)
def _place(
    body: HandBody,
    base: np.ndarray,
    start: np.ndarray,
    rate: np.ndarray,
    time: float,
    moving: np.ndarray,
    full: np.ndarray,
    poses: np.ndarray,
) -> None:
    for m in range(len(full)):
        if rate[m] != 0:
            full[m] = min(max(start[m] + rate[m] * time, body.limits[m, 0]), body.limits[m, 1])
    for link in range(len(moving)):
        if moving[link]:
            place_link(body.motions, link, full, base, poses)


@njit(cache=True)
def _settle(body: HandBody, field: Field, poses: np.ndarray, finger: int, stack: np.ndarray, hit: np.ndarray) -> bool:
    """Write to `hit` the one contact that stands for all of a distal link; return whether there is any.

    The fingertip circle where it touches; else, of all balls that lie on the surface, the one whose contact is
    nearest to their mean (k-means with one centre, and its medoid).
    """
    link = body.tip_links[finger]
    x, y, z = carry(poses, link, body.tips, finger)
    radius = body.tips[finger, 6]
    if abs(lower_bound(field, x, y, z) - radius) < GRID:
        nearest(field.tree, x, y, z, seed_at(field, x, y, z), hit)
        if abs(hit[0] - radius) <= FLAT and _on_circle(body, poses, finger, hit):
            return True
    found = np.empty((256, 7))
    count, top = 0, 1
    stack[0] = body.roots[link]
    while top and count < len(found):
        top -= 1
        node = stack[top]
        x, y, z = carry(poses, link, body.balls, node)
        radius = body.balls[node, 3]
        if lower_bound(field, x, y, z) - radius > FLAT:
            continue
        if body.children[node, 0] >= 0:
            stack[top], stack[top + 1] = body.children[node, 0], body.children[node, 1]
            top += 2
            continue
        nearest(field.tree, x, y, z, seed_at(field, x, y, z), found[count])
        if found[count, 0] - radius <= FLAT:
            count += 1
    if count == 0:
        return False
    x, y, z = found[:count, 1].mean(), found[:count, 2].mean(), found[:count, 3].mean()
    least, best = np.inf, 0
    for a in range(count):
        square = (found[a, 1] - x) ** 2 + (found[a, 2] - y) ** 2 + (found[a, 3] - z) ** 2
        if square < least - TIE:  # of equals, the first: rounding must not choose between mirrored contacts
            least, best = square, a
    hit[:] = found[best]
    return True


@njit(cache=True)
def _on_circle(body: HandBody, poses: np.ndarray, finger: int, hit: np.ndarray) -> bool:
    """Whether the fingertip circle's point opposite to the normal lies on the distal link's surface."""
    link, tip = body.tip_links[finger], body.tips[finger]
    at = np.empty(3)
    for j in range(3):
        along = 0.0
        for k in range(3):
            along += poses[link, k, j] * hit[4 + k]
        at[j] = tip[j] - tip[6] * along
    least = np.inf
    for p in range(len(body.part_links)):
        if body.part_links[p] == link:
            outside = -np.inf
            for s in range(body.parts[p], body.parts[p + 1]):
                side = body.planes[s]
                outside = max(outside, side[0] * at[0] + side[1] * at[1] + side[2] * at[2] - side[3])
            least = min(least, outside)
    return abs(least) <= 2 * FLAT


@njit(cache=True)
def _is_tip(body: HandBody, poses: np.ndarray, finger: int, hit: np.ndarray) -> bool:
    """Whether the contact lies near the fingertip circle, seen along the closing axis."""
    tip, pose = body.tips[finger], poses[body.tip_links[finger]]
    x, y, z = carry(poses, body.tip_links[finger], body.tips, finger)
    # Offset from the tip's centre and closing axis, both in the object frame; across = offset without its part along w.
    across = np.empty(3)
    w = np.empty(3)
    along = 0.0
    for k in range(3):
        w[k] = pose[k, 0] * tip[3] + pose[k, 1] * tip[4] + pose[k, 2] * tip[5]
    across[0], across[1], across[2] = hit[1] - x, hit[2] - y, hit[3] - z
    for k in range(3):
        along += across[k] * w[k]
    square = 0.0
    for k in range(3):
        square += (across[k] - along * w[k]) ** 2
    return square <= (TIP_REACH * tip[6]) ** 2


@njit(cache=True)
def _push(keys: np.ndarray, nodes: np.ndarray, size: int, key: float, node: int) -> int:
    i = size
    while i > 0 and keys[(i - 1) >> 1] > key:
        keys[i], nodes[i] = keys[(i - 1) >> 1], nodes[(i - 1) >> 1]
        i = (i - 1) >> 1
    keys[i], nodes[i] = key, node
    return size + 1


@njit(cache=True)
def _replace(keys: np.ndarray, nodes: np.ndarray, size: int, key: float, node: int) -> int:
    """Exchange the head of the heap for a later entry."""
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], nodes[i] = keys[child], nodes[child]
        i = child
    keys[i], nodes[i] = key, node
    return size
