"""Which fingers of a hand may touch in a grasp, and how a network tells it.

Fingers that share a closing joint (a parallel jaw) touch together or not at all.
"""

from itertools import product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.heads import CERTAIN


def finger_sets(hand: Hand, least: int | None = None, most: int | None = None) -> Bool[Tensor, "S F"]:
    """Return the sets of fingers, from `least` (None: the hand's own) to `most` (None: all), that can grasp.

    All fingers come first. A `least` of more than the hand has is all of them. Raises DexgraspError where no set is
    left, or where `least` is less than the hand's own.
    """
    count = len(hand.fingers)
    own = min(hand.least_fingers, count)
    low, high = own if least is None else min(least, count), count if most is None else most
    if low < own:
        raise DexgraspError(
            f"least_fingers of {own} or more for {hand.name!r}", str(least), f"let the hand: hand.least_fingers={least}"
        )
    groups = closing_groups(hand)
    rows = [[flags[group] for group in groups] for flags in product((True, False), repeat=max(groups) + 1)]
    sets = torch.tensor(rows)
    sets = sets[(sets.sum(dim=1) >= low) & (sets.sum(dim=1) <= high)]
    if not len(sets):
        raise DexgraspError(
            f"least_fingers and most_fingers that the {count} fingers of {hand.name!r} can meet",
            f"from {low} to {high}",
            "correct them in the group `synthesis`; fingers that share a closing joint count together",
        )
    return sets


def fewest_fingers(hand: Hand) -> int:
    """Return the size of the smallest set of fingers that can grasp."""
    return int(finger_sets(hand).sum(dim=1).min())


def closing_groups(hand: Hand) -> list[int]:
    """Return, per finger, the number of its group: fingers that share a closing joint, directly or by others'."""
    groups = list(range(len(hand.fingers)))
    for one, first in enumerate(hand.fingers):
        for other, second in enumerate(hand.fingers[:one]):
            if set(first.closing) & set(second.closing):
                groups = [groups[other] if group == groups[one] else group for group in groups]
    order = list(dict.fromkeys(groups))
    return [order.index(group) for group in groups]


def told_size(hand: Hand) -> int:
    """Return how many numbers tell which fingers touch: one a finger, none for hands that use all in every grasp."""
    return len(hand.fingers) if len(finger_sets(hand)) > 1 else 0


def told_fingers(hand: Hand, logits: Float[Tensor, "N F"] | None, finger: Int[Tensor, "N"]) -> Bool[Tensor, "N F"]:
    """Return the likeliest set of fingers that the hand can grasp with and that holds `finger`; None: all fingers."""
    if logits is None:
        return torch.ones(len(finger), len(hand.fingers), dtype=torch.bool, device=finger.device)
    sets = finger_sets(hand).to(logits.device)
    worth = logits @ (2.0 * sets.to(logits) - 1.0).T
    return sets[worth.masked_fill(~sets.T[finger], -torch.inf).argmax(dim=1)]


def fingers_loss(
    logits: Float[Tensor, "N F"], touching: Float[Tensor, "N F"], finger: Int[Tensor, "N"]
) -> Float[Tensor, "N"]:
    """Return the cross-entropy, summed over the fingers other than the telling one, which touches in any case."""
    each = F.binary_cross_entropy_with_logits(logits, touching.to(logits), reduction="none")
    return (each * (1 - F.one_hot(finger, logits.shape[1]).to(each))).sum(dim=1)


def fingers_as_prediction(touching: Float[Tensor, "N F"]) -> Float[Tensor, "N F"]:
    """Return logits that say which fingers touch, told as 1 or 0."""
    return CERTAIN * (2 * touching - 1)
