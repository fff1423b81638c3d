"""Hands whose fingers share a closing joint, moved so that these fingers touch together.

A parallel jaw meets an object with one finger first and pushes it, or gives way itself, until the other one touches
too. Which of them moves is the same to the grasp: here it is the hand. Its fingers close each on its own, and from how
far they get the hand's shift follows (Newton's method on the times of touch).
"""

from itertools import chain

import numpy as np
import torch

from dexgrasp.closing import CLOSED, close_fingers
from dexgrasp.distance import Field
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, hand_body
from dexgrasp.urdf import UrdfHand

ROUNDS = 6
TOGETHER = 1e-4
"""Fingers touch together if each would have to move by at most this, m."""
FARTHEST = 0.05
"""No hand is moved farther, m."""
SPLIT = 2
"""Status of a hand whose fingers do not come to touch together, as of one that misses (`closing.MISSES`)."""

Closed = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Centring:
    """Closes hands like `close_fingers`, but so that fingers which share a closing joint touch together."""

    def __init__(self, hand: Hand) -> None:
        self.body = hand_body(hand)
        assert isinstance(hand, UrdfHand)  # as `hand_body` makes sure
        self.hand = hand
        self.groups = shared_fingers(self.body.rates)
        self.apart, self.sources = _apart(self.body, self.groups) if self.groups else (self.body, np.zeros(0, int))

    def close(
        self,
        field: Field,
        bases: np.ndarray,
        joints: np.ndarray,
        strict: bool = False,
        limit: float = np.inf,
        touching: np.ndarray | None = None,
    ) -> Closed:
        """Close N hands object_T_base (N, 3, 4) from `joints` (N, J); see `close_fingers`.

        Returns the bases where the fingers touch together, then what `close_fingers` returns.
        """
        if not self.groups:
            return bases, *close_fingers(self.body, field, bases, joints, False, strict, limit, touching)
        chosen = np.ones((len(bases), len(self.body.rates)), bool) if touching is None else touching
        bases, start = bases.copy(), np.ascontiguousarray(joints[:, self.sources])
        rates = self.apart.rates @ self.apart.coupling.T
        begin = start @ self.apart.coupling.T + self.apart.offset
        times, away = np.full((len(bases), len(rates)), np.nan), np.zeros(len(bases))
        rows = np.arange(len(bases))
        found = close_fingers(self.apart, field, bases, start, False, strict, limit, chosen)
        status, full, touches, on_tip, depth = found
        for number in range(ROUNDS):
            if number:  # only those whose fingers do not touch together yet
                again = close_fingers(self.apart, field, bases[rows], start[rows], False, strict, limit, chosen[rows])
                for whole, part in zip(found, again, strict=True):
                    whole[rows] = part
            times[rows] = np.stack([_times(full[rows] - begin[rows], rate) for rate in rates], axis=1)
            rows = rows[status[rows] == CLOSED]
            shift, away[rows] = self._shift(bases[rows], full[rows], touches[rows], times[rows], rates)
            late = away[rows] > TOGETHER
            rows, shift = rows[late], shift[late]
            if len(rows) == 0 or number == ROUNDS - 1:
                break
            bases[rows, :, 3] += shift
        split = (status == CLOSED) & (away > TOGETHER)
        status[split], on_tip[split] = SPLIT, False
        for group in self.groups:
            mean = times[:, group].mean(axis=1, keepdims=True)
            rows = np.flatnonzero(rates[group].any(axis=0))
            full[:, rows] = np.clip(begin[:, rows] + mean * rates[group].sum(axis=0)[rows], *self.body.limits[rows].T)
        return bases, status, full, touches, on_tip, depth

    def _shift(
        self, bases: np.ndarray, full: np.ndarray, touches: np.ndarray, times: np.ndarray, rates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the shift (N, 3) of the base after which fingers touch together, and how far they are from it, m."""
        shift, away = np.zeros((len(bases), 3)), np.zeros(len(bases))
        for group in self.groups:
            slopes, speeds = [], []
            for finger in group:
                normal = touches[:, finger, 3:]
                speed = self._speed(bases, full, touches[:, finger], finger, rates[finger])
                closing = np.einsum("ni,ni->n", speed, normal)
                slopes.append(-normal / np.where(closing < -1e-3, closing, np.nan)[:, None])
                speeds.append(np.linalg.norm(speed, axis=1))
            matrix = np.stack([slope - slopes[0] for slope in slopes[1:]], axis=1)
            wanted = times[:, group[0], None] - times[:, group[1:]]
            known = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1)
            solved = np.einsum("nij,nj->ni", np.linalg.pinv(matrix[known], rcond=1e-3), wanted[known])
            far = np.linalg.norm(solved, axis=1) > FARTHEST
            shift[known] += np.where(far[:, None], 0.0, solved)
            spread = np.abs(times[:, group] - times[:, group].mean(axis=1, keepdims=True)) * np.stack(speeds, axis=1)
            closed = np.isfinite(touches[:, group, 0]).any(axis=1)  # else none of them was to close
            away = np.maximum(away, np.where(known, spread.max(axis=1), np.where(closed, np.inf, 0.0)))
        return shift, away

    def _speed(
        self, bases: np.ndarray, full: np.ndarray, touch: np.ndarray, finger: int, rate: np.ndarray
    ) -> np.ndarray:
        """Return the velocity (N, 3), m per unit of closing, at which a finger's tip comes to what it touches."""
        link, step = self.hand.link_names[self.body.tip_links[finger]], 1e-5
        near = [self.hand.full_link_poses(torch.from_numpy(full + side * step * rate))[link] for side in (-1, 1)]
        before, after = (np.einsum("nij,njk->nik", bases[:, :, :3], pose[:, :3].numpy()) for pose in near)
        at = touch[:, :3] - bases[..., 3] - before[..., 3]
        local = np.einsum("nji,nj->ni", before[..., :3], at)
        return (np.einsum("nij,nj->ni", after[..., :3], local) + after[..., 3] - at - before[..., 3]) / (2 * step)


def shared_fingers(rates: np.ndarray) -> list[list[int]]:
    """Return the groups of fingers (F, J) that share a closing joint, those of two or more."""
    groups: list[list[int]] = []
    for finger, rate in enumerate(rates):
        joined = [group for group in groups if any((rates[other] != 0)[rate != 0].any() for other in group)]
        groups = [group for group in groups if group not in joined] + [sorted([finger, *chain.from_iterable(joined)])]
    return [group for group in groups if len(group) > 1]


def _apart(body: HandBody, groups: list[list[int]]) -> tuple[HandBody, np.ndarray]:
    """Return a hand in which each of these fingers has closing joints of its own, and what joint each of its is."""
    chains = []
    for link in body.tip_links:
        way, at = np.zeros(len(body.coupling), bool), int(link)
        while at >= 0:
            if body.drives[at] >= 0:
                way[body.drives[at]] = True
            at = int(body.parents[at])
        chains.append(way)
    columns, rates = [body.coupling.copy()], [body.rates.copy()]
    sources, limits = [np.arange(body.coupling.shape[1])], [body.joint_limits]
    for group in groups:
        for number, finger in enumerate(group[1:], 1):
            # What no other finger of the group hangs on moves by this finger's own joints.
            others = np.any([chains[other] for other in group[:number]], axis=0)
            own, joints = chains[finger] & ~others, np.flatnonzero(body.rates[finger])
            columns.append(np.where(own[:, None], body.coupling[:, joints], 0.0))
            columns[0][np.ix_(own, joints)] = 0.0
            told = np.zeros((len(body.rates), len(joints)))
            told[finger] = body.rates[finger, joints]
            rates[0][finger, joints] = 0.0
            rates.append(told)
            sources.append(joints)
            limits.append(body.joint_limits[joints])
    split = body._replace(
        coupling=np.ascontiguousarray(np.concatenate(columns, axis=1)),
        rates=np.ascontiguousarray(np.concatenate(rates, axis=1)),
        joint_limits=np.ascontiguousarray(np.concatenate(limits)),
    )
    return split, np.concatenate(sources)


def _times(moved: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return for how long (N,) a finger closed that moved its joints (N, M) by so much."""
    rows = np.flatnonzero(rate)
    return (moved[:, rows] / rate[rows]).max(axis=1)
