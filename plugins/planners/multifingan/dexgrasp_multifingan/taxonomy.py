"""A hand's own grasp types: clusters of its grasps' postures, and where the object lies in the hand in each."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from torch import Tensor

from dexgrasp.seeds import stream

MOST = 20_000
"""Grasps that are clustered."""


class Taxonomy(NamedTuple):
    """K types of grasps."""

    joints: Float[Tensor, "K J"]
    """Mean posture, rad or m."""
    centre: Float[Tensor, "K 3"]
    """Where the object's middle lies on average in the palm frame, m."""
    touching: Bool[Tensor, "K F"]
    """Fingers that touch in at least half of the grasps."""


def taxonomy(
    joints: Float[Tensor, "N J"],
    centres: Float[Tensor, "N 3"],
    touching: Bool[Tensor, "N F"],
    ranges: Float[Tensor, "J"],
    count: int,
    seed: int,
) -> tuple[Taxonomy, Int[Tensor, "N"]]:
    """Return types by k-means on joints in units of their ranges, and the type of each grasp.

    `centres` is the object's middle in each grasp's palm frame (m). Types without a grasp repeat the first one that
    has some.
    """
    rows = (joints / ranges).double()
    few = rows[torch.from_numpy(stream(seed, "types").permutation(len(rows))[:MOST])].numpy()
    middles, _ = kmeans2(few, count, minit="++", rng=stream(seed, "k-means"), missing="warn")
    own = torch.cdist(rows, torch.from_numpy(middles)).argmin(1)
    told = [own == number for number in range(count)]
    some = next(rows for rows in told if rows.any())
    told = [rows if rows.any() else some for rows in told]
    found = Taxonomy(
        torch.stack([joints[rows].mean(0) for rows in told]).float(),
        torch.stack([centres[rows].mean(0) for rows in told]).float(),
        torch.stack([touching[rows].double().mean(0) >= 0.5 for rows in told]),
    )
    return found, own
