"""Fingers that do not touch must be out of the way."""

import copy

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField
from dexgrasp.grasps import Grasps

CLEAR = 5e-4
"""Fingers that do not touch stay this far from the object, m: the balls that follow their surface err by less."""


class OpenFingers:
    """The links that closing each finger of a hand moves."""

    def __init__(self, shape: HandShape) -> None:
        self.shapes = [_only(shape, finger) for finger in range(len(shape.body.rates))]

    def clear(self, field: DistanceField, grasps: Grasps) -> Bool[Tensor, "N"]:
        """Return of which grasps (object frame) the fingers that do not touch are clear of the object."""
        clear = torch.ones(len(grasps), dtype=torch.bool)
        for number, shape in enumerate(self.shapes):
            rows = (~grasps.touching[:, number]).nonzero().flatten()
            if len(rows):
                clear[rows] &= shape.approach_clear(field, grasps.pose[rows], grasps.joints[rows], 0.0, -CLEAR)
        return clear


def _only(shape: HandShape, finger: int) -> HandShape:
    """Return a shape that has but the links which closing one finger moves."""
    body = shape.body
    rate = body.coupling @ body.rates[finger]
    moved = np.zeros(len(body.roots), bool)
    for link, (parent, drive) in enumerate(zip(body.parents, body.drives, strict=True)):
        moved[link] = (parent >= 0 and moved[parent]) or (drive >= 0 and rate[drive] != 0)
    alone = copy.copy(shape)
    alone.body = body._replace(roots=np.where(moved, body.roots, -1))
    return alone
