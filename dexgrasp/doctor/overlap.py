"""Which links of a hand overlap in a posture, and how deep."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import fcl
import numpy as np
import torch
import trimesh

from dexgrasp.doctor.solid import bodies
from dexgrasp.hand import Hand

LEAST = 5e-4
"""Overlaps below this are touching, m."""


@dataclass(frozen=True)
class Overlap:
    """Two bodies (links that move as one, told by their first link) that overlap."""

    first: str
    second: str
    depth: float
    """m."""
    above: bool
    """Whether one carries the other, by one body between them."""


class SelfOverlap:
    """Convex parts of a hand, ready to be tried against each other. Bodies that a joint connects are left out."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        groups = bodies(hand)
        owner = {link: first for first, links in groups.items() for link in links}
        tree = getattr(hand, "tree", ())
        self.parent = {owner[r.name]: owner[tree[r.parent].name] for r in tree if r.parent >= 0 and r.joint is not None}
        self.parts = {
            first: [(link, _shape(part)) for link in links for part in hand.collisions.get(link, ())]
            for first, links in groups.items()
        }

    def at(self, joints: torch.Tensor) -> Iterator[Overlap]:
        """Yield what overlaps by more than `LEAST` in one posture (J,)."""
        poses = {link: pose[0].numpy() for link, pose in self.hand.link_poses(joints[None]).items()}
        placed = {
            first: [fcl.CollisionObject(shape, fcl.Transform(poses[link][:3, :3], poses[link][:3, 3]))
                    for link, shape in parts]
            for first, parts in self.parts.items()
        }  # fmt: skip
        for first, second in combinations(placed, 2):
            if self.parent.get(first) == second or self.parent.get(second) == first:
                continue
            depth = max((_depth(a, b) for a in placed[first] for b in placed[second]), default=0.0)
            if depth > LEAST:
                above = first == self._grandparent(second) or second == self._grandparent(first)
                yield Overlap(first, second, depth, above)

    def _grandparent(self, body: str) -> str | None:
        return self.parent.get(self.parent.get(body, ""))


def _shape(part: trimesh.Trimesh) -> fcl.Convex:
    faces = np.column_stack([np.full(len(part.faces), 3), part.faces]).ravel()
    return fcl.Convex(np.asarray(part.vertices, dtype=np.float64), len(part.faces), faces.astype(np.int64))


def _depth(first: fcl.CollisionObject, second: fcl.CollisionObject) -> float:
    result = fcl.CollisionResult()
    fcl.collide(first, second, fcl.CollisionRequest(num_max_contacts=4, enable_contact=True), result)
    return max((abs(contact.penetration_depth) for contact in result.contacts), default=0.0)
