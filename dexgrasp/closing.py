"""Closing a hand's fingers on an object, each until it touches: conservative advancement on the joint angles."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.collision import as_arrays, deepest
from dexgrasp.distal_contact import distal_contact, is_tip
from dexgrasp.distance import DistanceField, Field, estimate, lower_bound, seed_at
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_link, place_links
from dexgrasp.heap import push, replace
from dexgrasp.triangle_tree import nearest

TOUCH = 2e-5
"""A finger touches where the gap is at most this, m."""
NEAR = 0.5
"""A bounding ball is split once the surface is nearer than this many times what splitting may gain."""
CLOSE = 1e-3
"""Below this the grid's lower bound gives way to distances to triangles, m."""
DOUBT = 5e-5
"""Allowance for triangles that a cell does not name, m; nearer than twice this the exact distance decides."""

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
                    if not distal_contact(body, field, poses, other, nodes, hit):
                        continue
                    on_tip[i, other] = is_tip(body, poses, other, hit)
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
            size = push(keys, nodes, size, 0.0, body.roots[link])
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
                size = replace(keys, nodes, size, time + gap / body.speeds[finger, node], node)
            else:
                size = replace(keys, nodes, size, time, left)
                size = push(keys, nodes, size, time, body.children[node, 1])
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
        size = replace(keys, nodes, size, time + gap / body.speeds[finger, node], node)
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
