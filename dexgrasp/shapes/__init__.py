"""The embedded procedural object set: families of household shapes, each drawn together with its convex parts."""

from collections.abc import Callable

import numpy as np

from dexgrasp.shapes import basic, household, tools, vessels
from dexgrasp.shapes.solid import Solid

Family = Callable[[np.random.Generator], Solid]


def _named(*families: Family) -> dict[str, Family]:
    return {family.__name__: family for family in families}


FAMILIES: dict[str, Family] = _named(
    basic.box, basic.cylinder, vessels.mug, tools.hammer, vessels.bottle, basic.ball, vessels.bowl, tools.bracket,
    basic.torus, vessels.spray_bottle, household.banana, basic.polygon, vessels.cup, tools.screwdriver, household.bulb,
    basic.capsule, vessels.pan, household.controller, vessels.dispenser, basic.dumbbell, vessels.wine_glass,
    tools.clamp, household.figure, basic.cone, vessels.jar, tools.brush, household.apple, vessels.dish,
    household.stapler, basic.block, vessels.vase, household.mouse,
)  # fmt: skip
"""Families of the training split; a smaller count takes the first ones of this mixed order."""
HELD_OUT: dict[str, Family] = _named(
    vessels.teapot, tools.flashlight, household.camera, vessels.watering_can, household.plane, vessels.carton,
    tools.wrench, household.car, household.pear, tools.scoop, tools.roller, household.bell, basic.wedge,
)  # fmt: skip
"""Families that only the test split has."""
