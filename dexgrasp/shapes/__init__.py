"""The embedded procedural object set: families of household shapes, each with its convex parts."""

from collections.abc import Callable

import numpy as np

from dexgrasp.shapes import basic, vessels
from dexgrasp.shapes.solid import Solid

Family = Callable[[np.random.Generator], Solid]

FAMILIES: dict[str, Family] = {
    "box": basic.brick,
    "cylinder": basic.cylinder,
    "ball": basic.ball,
    "capsule": basic.capsule,
    "bowl": vessels.bowl,
    "mug": vessels.mug,
    "bottle": vessels.bottle,
}
"""Families of the training split."""
HELD_OUT: dict[str, Family] = {}
"""Families that only the test split has."""
