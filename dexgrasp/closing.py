"""Closing a hand's fingers on an object, each until it touches: conservative advancement on the joint angles."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.advance import Scratch, advance, advance_scratch
from dexgrasp.batch import Batch
from dexgrasp.borrow import borrowed
from dexgrasp.collision import as_arrays, deepest
from dexgrasp.distal_contact import BLUR, MOST, distal_contact, is_tip
from dexgrasp.distance import DistanceField, Field, interpolated, quick_bound, seed_at
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_links
from dexgrasp.triangle_tree import nearest

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
        centred: bool = False,
        touching: Bool[Tensor, "N F"] | None = None,
    ) -> Closure:
        """Close hands at object_T_base `pose` (m) from the posture `joints`.

        With `breakaway`, links beyond one that touches go on until they touch themselves (BarrettHand's clutch).
        With `centred`, hands are first moved so that fingers which share a closing joint touch together; those that
        cannot touch with no tip. Fingers that are not `touching` do not close; None: all do.
        """
        base, start = as_arrays(pose, joints)
        chosen = None if touching is None else touching.numpy()
        if centred and not breakaway:
            from dexgrasp.centring import Centring  # it closes with `close_fingers`

            _, _, full, touches, on_tip, depth = Centring(self.hand).close(field.field, base, start, touching=chosen)
        else:
            found = close_fingers(self.body, field.field, base, start, breakaway, False, np.inf, chosen)
            _, full, touches, on_tip, depth = found
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


def close_fingers(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    breakaway: bool,
    strict: bool,
    limit: float,
    touching: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Close N hands; return status (N,), full joints (N, M), contact and normal (N, F, 6), on tip (N, F), depth (N,).

    With `strict`, a hand that starts deeper than `limit` (m) in the object, or one of whose fingers misses or does
    not touch with its tip, is given up at once: its status says why and its depth is not measured. Only fingers that
    are `touching` (N, F) close and are meant; None: all.
    """
    chosen = np.ones((len(bases), len(body.tip_links)), np.bool_) if touching is None else touching
    return _close_chosen(body, field, bases, joints, np.ascontiguousarray(chosen), breakaway, strict, limit)


@njit(cache=True)
def _close_chosen(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    chosen: np.ndarray,
    breakaway: bool,
    strict: bool,
    limit: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    count, fingers = len(bases), len(body.tip_links)
    status = np.zeros(count, np.int64)
    full = np.zeros((count, len(body.offset)))
    touches = np.full((count, fingers, 6), np.nan)
    on_tip = np.zeros((count, fingers), np.bool_)
    depth = np.zeros(count)
    links, parts, joint_count = len(body.parents), len(body.part_links), len(body.offset)
    # The compiled code that is called gets all its arrays as arguments: only these may be borrowed there.
    _close(
        body, field, bases, joints, chosen, breakaway, strict, limit,
        (status, full, touches, on_tip, depth),
        (np.empty((links, 3, 4)), np.empty(joint_count), np.zeros(fingers, np.bool_), np.zeros(links, np.bool_)),
        (np.zeros((parts, 3)), np.empty((MOST, 8)), np.empty(7), np.empty(7)),
        advance_scratch(body),
    )  # fmt: skip
    return status, full, touches, on_tip, depth


@njit(cache=True)
def _close(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    chosen: np.ndarray,
    breakaway: bool,
    strict: bool,
    limit: float,
    results: tuple[np.ndarray, ...],
    of_links: tuple[np.ndarray, ...],
    of_contacts: tuple[np.ndarray, ...],
    scratch: Scratch,
) -> None:
    body, field, bases, joints = borrowed(body), borrowed(field), borrowed(bases), borrowed(joints)
    chosen = borrowed(chosen)
    status, full, touches, on_tip, depth = borrowed(results)
    poses, rate, done, free = borrowed(of_links)
    ways, found, hit, contact = borrowed(of_contacts)
    scratch = borrowed(scratch)
    count, fingers = len(bases), len(body.tip_links)
    for i in range(count):
        place_links(body, joints[i], bases[i], full[i], poses)
        if strict and deepest(body, field, poses, -limit, True) < -limit:
            status[i] = PENETRATES
            continue
        for finger in range(fingers):
            done[finger] = not chosen[i, finger]
        free[:] = False
        ways[:] = 0.0
        for finger in range(fingers):
            if done[finger]:
                continue
            for m in range(len(rate)):
                rate[m] = 0.0
                for j in range(joints.shape[1]):
                    rate[m] += body.coupling[m, j] * body.rates[finger, j]
            while True:
                touched = advance(body, field, bases[i], finger, rate, full[i], poses, free, ways, scratch, hit)
                if not breakaway or touched < 0 or touched == body.tip_links[finger]:
                    break
                # The link that touches and all above it stop; what lies beyond goes on.
                link = touched
                while link >= 0:
                    if body.drives[link] >= 0:
                        rate[body.drives[link]] = 0.0
                    link = body.parents[link]
            for other in range(finger, fingers):
                shared = other == finger
                for j in range(joints.shape[1]):
                    shared |= body.rates[finger, j] != 0 and body.rates[other, j] != 0
                if not shared or touched < 0:
                    continue
                done[other] = True
                tip = body.tip_links[other]
                if touched == tip or not _above(body.parents, touched, tip):
                    if not distal_contact(body, field, poses, other, touched == tip, scratch.nodes, found, contact):
                        continue
                    on_tip[i, other] = is_tip(body, poses, other, contact)
                    touches[i, other] = contact[1:7]
                else:
                    touches[i, other] = hit[1:7]
            if strict and not on_tip[i, finger]:
                status[i] = MISSES if np.isnan(touches[i, finger, 0]) else OFF_TIP
                break
        if not strict:
            depth[i] = _depth(body, field, poses, free, scratch.nodes, hit)


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
    values, boxes, h = field.values, tree.boxes, field.spacing
    a, b, c = field.origin
    best = 0.0
    for link in range(len(free)):
        if free[link] or body.roots[link] < 0:
            continue
        stack[0], top = body.roots[link], 1
        while top:
            top -= 1
            node = stack[top]
            x, y, z = carry(poses, link, balls, node)
            if quick_bound(values, boxes, a, b, c, h, x, y, z, balls[node, 3] - best) >= balls[node, 3] - best:
                continue
            if children[node, 0] >= 0:
                stack[top], stack[top + 1] = children[node, 0], children[node, 1]
                top += 2
            elif interpolated(field, x, y, z) - balls[node, 3] < BLUR - best:
                nearest(tree, x, y, z, seed_at(field, x, y, z), hit)
                best = max(best, balls[node, 3] - hit[0])
    return best
