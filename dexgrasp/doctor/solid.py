"""Links as unions of convex parts, and postures from open to closed: what the checks of a loaded hand measure with."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.ball_tree import planes
from dexgrasp.execution import closing_direction
from dexgrasp.hand import Hand
from dexgrasp.seeds import stream

STEP, RANGE = 1e-4, 0.08
"""Rays are followed in steps of the first as far as the second, m."""


def outside(parts: Sequence[trimesh.Trimesh], points: np.ndarray) -> np.ndarray:
    """Return how far points (P, 3) lie outside a union of convex parts: a lower bound, m; negative inside."""
    found = np.full(len(points), np.inf)
    for part in parts:
        sides = planes(part)
        found = np.minimum(found, (points @ sides[:, :3].T - sides[:, 3]).max(axis=1))
    return found


def way_out(parts: Sequence[trimesh.Trimesh], point: np.ndarray, direction: np.ndarray) -> float:
    """Return the distance from a point within convex parts to where a ray leaves them for good, m; 0 from outside."""
    steps = np.arange(0, RANGE, STEP)
    within = outside(parts, point + steps[:, None] * direction) <= 0
    return float(steps[within][-1]) if within.any() else 0.0


def bodies(hand: Hand) -> dict[str, list[str]]:
    """Return the links that move as one, by the first of them; each link alone where the hand tells no tree."""
    found: dict[str, list[str]] = {}
    carrier: dict[str, str] = {}
    tree = getattr(hand, "tree", None)
    if tree is None:
        return {link: [link] for link in hand.link_names}
    for record in tree:
        fixed = record.joint is None and record.parent >= 0
        carrier[record.name] = carrier[tree[record.parent].name] if fixed else record.name
        found.setdefault(carrier[record.name], []).append(record.name)
    return found


def closed_by(hand: Hand, part: float, others: Float[Tensor, "N J"] | None = None) -> Float[Tensor, "N J"]:
    """Return postures whose closing joints stand at `part` (0 open, 1 closed) of their ranges.

    `others` gives the remaining joints; by default these are 0, or the limit nearest to it.
    """
    result = (
        hand.clamp(torch.zeros(1, len(hand.joint_names), dtype=torch.float64)) if others is None else others.clone()
    )
    direction = closing_direction(hand)
    low, high = hand.limits.T
    start, end = torch.where(direction < 0, high, low), torch.where(direction < 0, low, high)
    return torch.where(direction != 0, start + part * (end - start), result)


def drawn(hand: Hand, count: int) -> Float[Tensor, "N J"]:
    """Return postures drawn uniformly within the limits, the same ones each time."""
    unit = torch.from_numpy(stream(0, "doctor", hand.name).uniform(size=(count, len(hand.joint_names))))
    return hand.limits[:, 0] + unit * (hand.limits[:, 1] - hand.limits[:, 0])
