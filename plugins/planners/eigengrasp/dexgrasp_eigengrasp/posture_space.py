"""The low-dimensional space of postures in which is searched: eigengrasps of a hand."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.synergies import Synergy


def posture_space(hand: Hand, synergy: str | None = None) -> Synergy:
    """Return the eigengrasps of a hand, of all its joints; every amplitude is from 0 to 1.

    Those of the hand's first synergy, or of the one named; joints that it does not tell get directions of their own.
    Without any: one direction that closes all fingers, from open to closed, and one for each joint that closes none,
    such as a BarrettHand's spread (as Ciocarlie & Allen 2009 choose for that hand). Raises DexgraspError for an
    unknown synergy.
    """
    if synergy is not None and synergy not in hand.synergies:
        known = ", ".join(hand.synergies) or "none"
        raise DexgraspError(f"a synergy of hand {hand.name!r}: {known}", repr(synergy), "leave it null")
    low, high = hand.limits.T
    start = low.clone()
    if hand.synergies:
        told = hand.synergies[synergy or next(iter(hand.synergies))]
        names = told.joints
        least, most = told.amplitudes.T
        start[hand.joint_index(names)] = told.postures(least[None])[0]
        axes = [_axis(hand, names, row) for row in (most - least)[:, None] * told.axes]
    else:
        rates = {joint: rate for finger in hand.fingers for joint, rate in finger.closing.items()}
        names = tuple(rates)
        places = hand.joint_index(names)
        forth = torch.tensor([rate > 0 for rate in rates.values()])
        start[places] = torch.where(forth, low[places], high[places])
        axes = [_axis(hand, names, torch.where(forth, 1.0, -1.0) * (high - low)[places])]
    for joint in hand.joint_names:
        if joint not in names:
            axes.append(_axis(hand, (joint,), (high - low)[hand.joint_index((joint,))]))
    ends = torch.tensor([[0.0, 1.0]], dtype=torch.float64).repeat(len(axes), 1)
    return Synergy(hand.joint_names, start, torch.stack(axes), ends)


def _axis(hand: Hand, names: Sequence[str], values: Float[Tensor, "D"]) -> Float[Tensor, "J"]:
    axis = torch.zeros(len(hand.joint_names), dtype=torch.float64)
    axis[hand.joint_index(tuple(names))] = values.double()
    return axis
