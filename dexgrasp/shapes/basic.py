"""Plain bodies: many household things are one of these."""

import numpy as np

from dexgrasp.shapes.outline import arc
from dexgrasp.shapes.solid import Solid, balls, ellipsoid, prism
from dexgrasp.shapes.solid import box as rounded_box
from dexgrasp.shapes.turned import lathe, ring

Rng = np.random.Generator


def box(rng: Rng) -> Solid:
    """A carton or a wooden block."""
    sides = np.sort(rng.uniform([0.03, 0.04, 0.06], [0.06, 0.085, 0.16]))
    return rounded_box(rng.permutation(sides), rng.uniform(0.001, 0.006))


def cylinder(rng: Rng) -> Solid:
    """A can."""
    radius, half, edge = rng.uniform(0.02, 0.045), rng.uniform(0.03, 0.075), rng.uniform(0.0015, 0.005)
    bottom = arc((radius - edge, edge - half), edge, -90, 0, 4)
    return lathe(np.vstack([bottom, bottom[::-1] * [1, -1]]))


def ball(rng: Rng) -> Solid:
    """A ball or an egg: an ellipsoid."""
    return ellipsoid(rng.uniform(0.024, 0.042) * rng.uniform(0.8, 1.25, size=3))


def capsule(rng: Rng) -> Solid:
    """A bar with round ends."""
    radius, half = rng.uniform(0.016, 0.032), rng.uniform(0.025, 0.07)
    bottom = arc((0, -half), radius, -90, 0, 10)
    return lathe(np.vstack([bottom, bottom[::-1] * [1, -1]]))


def cone(rng: Rng) -> Solid:
    """A blunt cone: a pylon, an upturned beaker."""
    wide, narrow, height = rng.uniform(0.032, 0.048), rng.uniform(0.01, 0.024), rng.uniform(0.06, 0.13)
    top = arc((narrow - 0.003, height - 0.003), 0.003, 10, 90, 4)
    return lathe(np.vstack([arc((wide - 0.003, 0.003), 0.003, -90, 10, 4), top]))


def polygon(rng: Rng) -> Solid:
    """A prism of three to six sides."""
    sides, radius = int(rng.integers(3, 7)), rng.uniform(0.028, 0.045)
    turn = 2 * np.pi * (np.arange(sides) + rng.uniform(-0.12, 0.12, sides)) / sides
    return prism(radius * np.column_stack([np.cos(turn), np.sin(turn)]), rng.uniform(0.04, 0.14), 0.003)


def torus(rng: Rng) -> Solid:
    """A ring: a quoit, a roll of tape."""
    return ring(rng.uniform(0.03, 0.055), rng.uniform(0.01, 0.018))


def dumbbell(rng: Rng) -> Solid:
    """Two heads on a bar."""
    head, bar, half = rng.uniform(0.025, 0.038), rng.uniform(0.011, 0.016), rng.uniform(0.02, 0.045)
    thick = rng.uniform(0.03, 0.05)
    outer = arc((head - 0.006, half + thick - 0.006), 0.006, 0, 90, 4)
    inner = arc((head - 0.006, half + 0.006), 0.006, -90, 0, 4)
    upper = np.vstack([[bar, half - 0.002], inner, outer])
    return lathe(np.vstack([upper[::-1] * [1, -1], upper]))


def block(rng: Rng) -> Solid:
    """A toy brick with studs."""
    pitch = rng.uniform(0.024, 0.034)
    rows, columns, height = 2, int(rng.integers(2, 4)), rng.uniform(0.035, 0.06)
    solid = rounded_box([columns * pitch, rows * pitch, height], 0.002)
    for column in range(columns):
        for row in range(rows):
            stud = lathe([[0.3 * pitch, 0], [0.3 * pitch, 0.008], [0.3 * pitch - 0.001, 0.009]])
            place = [(column - (columns - 1) / 2) * pitch, (row - (rows - 1) / 2) * pitch, height / 2 - 0.001]
            solid |= stud.at(place)
    return solid


def wedge(rng: Rng) -> Solid:
    """A ramp or a doorstop."""
    length, height, width = rng.uniform(0.07, 0.12), rng.uniform(0.035, 0.06), rng.uniform(0.035, 0.06)
    edge = 0.004
    side = [(edge, edge), (length - 2 * edge, edge), (edge, height - edge), (length - 2 * edge, 0.012)]
    return balls([(x, y, z) for x, z in side for y in (edge - width / 2, width / 2 - edge)], edge)
