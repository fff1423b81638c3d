"""How much grasps that are alike back each other."""

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.grasps import Grasps

LIKE_DISTANCE, LIKE_ANGLE = 0.02, 0.3
"""Scale on which two grasps are alike: bases apart, m; rotations and joints apart, rad."""

DOUBT = 2.0
"""Grasps like a best one that are taken to fail. Of 416 objects in clutter `lift-v1` lifted 92.3 % at the grasp with
the largest sum of `load_capacity.lifts`, 95.2 % at the one with the largest mean with this doubt."""


def support(grasps: Grasps, worth: Float[Tensor, "N"], doubt: float | None = None) -> Float[Tensor, "N"]:
    """Return the `worth` of each grasp, summed over the grasps of its object that are like it (Gaussian weights).

    With `doubt` their mean, as if so many more like it were worth nothing: what few others back is taken to be worse
    than it looks, but many grasps of little worth are no good one.

    Where many grasps are alike, a small error still gives a grasp; and neighbouring points are labelled with grasps of
    one kind, not with whichever is best by a hair, so that the labels can be learnt.
    """
    result = torch.zeros_like(worth)
    for number in grasps.object.unique().tolist():
        row = (grasps.object == number).nonzero().flatten()
        own = grasps[row]
        pose = own.pose.double()
        # |R - S|^2 = 4 (1 - cos angle), about 2 angle^2; columns of one embedding, so that one distance says all.
        like = torch.cat(
            [
                pose[:, :3, 3] / LIKE_DISTANCE,
                pose[:, :3, :3].flatten(1) / (2**0.5 * LIKE_ANGLE),
                own.joints.double() / LIKE_ANGLE,
            ],
            dim=1,
        )
        weight = torch.exp(-0.5 * torch.cdist(like, like, compute_mode="donot_use_mm_for_euclid_dist").square())
        total = weight @ worth[row].double()
        result[row] = (total if doubt is None else total / (weight.sum(dim=1) + doubt)).to(result)
    return result
