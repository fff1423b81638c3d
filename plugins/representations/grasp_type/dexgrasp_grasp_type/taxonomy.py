"""A hand's own grasp types: clusters of the postures that its grasps have."""

from collections.abc import Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.seeds import stream

PER_OBJECT = 300
"""Grasps of each object that count, so that no object of many grasps decides alone."""
STARTS, STEPS = 4, 100
"""Of k-means: the start with the least spread wins; steps until no grasp changes its cluster, or so many."""


def taxonomy(hand: Hand, grasps: Iterable[Grasps], count: int) -> Float[Tensor, "K J"]:
    """Return the mean postures of `count` types (rad or m), most common first, float64.

    k-means (k-means++ starts) on joints in units of their ranges, over some grasps of each object. The same for the
    same grasps. Types are repeated where there are fewer different grasps.
    """
    postures = [_drawn(own.joints.double(), number) for number, own in enumerate(grasps)]
    lower, upper = hand.limits.double().unbind(-1)
    ranges = torch.where(upper > lower, upper - lower, 1.0)
    share = (torch.cat([lower[None, :][:0], *postures]) - lower) / ranges
    if not len(share):
        return drawn_postures(hand, count)
    found = [_k_means(share, count, start) for start in range(STARTS)]
    centres = min(found, key=lambda each: float(_squares(share, each).amin(1).sum()))
    size = torch.bincount(_squares(share, centres).argmin(1), minlength=count)
    return lower + centres[size.argsort(descending=True, stable=True)] * ranges


def drawn_postures(hand: Hand, count: int) -> Float[Tensor, "K J"]:
    """Return postures drawn evenly between the limits: types of a hand of which no grasp is known."""
    lower, upper = hand.limits.double().unbind(-1)
    share = torch.from_numpy(stream(0, "grasp types").random((count, len(lower))))
    return lower + share * (upper - lower)


def _drawn(joints: Float[Tensor, "N J"], number: int) -> Float[Tensor, "M J"]:
    return joints[torch.from_numpy(stream(0, "grasp types", number).permutation(len(joints))[:PER_OBJECT])]


def _k_means(rows: Float[Tensor, "N J"], count: int, start: int) -> Float[Tensor, "K J"]:
    rng = stream(0, "k-means", start)
    centres = rows[rng.integers(len(rows), size=1)]
    while len(centres) < count:
        far = _squares(rows, centres).amin(1)
        weights = (far if far.sum() > 0 else torch.ones_like(far)).numpy()
        centres = torch.cat([centres, rows[[rng.choice(len(rows), p=weights / weights.sum())]]])
    cluster = torch.full((len(rows),), -1)
    for _ in range(STEPS):
        nearest = _squares(rows, centres).argmin(1)
        if torch.equal(nearest, cluster):
            break
        cluster = nearest
        for number in cluster.unique().tolist():
            centres[number] = rows[cluster == number].mean(0)
    return centres


def _squares(rows: Float[Tensor, "N J"], centres: Float[Tensor, "K J"]) -> Float[Tensor, "N K"]:
    return (rows.unsqueeze(1) - centres).square().sum(-1)


def nearest_type(
    joints: Float[Tensor, "N J"], centres: Float[Tensor, "K J"], ranges: Float[Tensor, "J"]
) -> Int[Tensor, "N"]:
    """Return the type nearest to each posture, joints in units of their ranges."""
    return _squares(joints / ranges, centres / ranges).argmin(1)
