"""Plain bodies: most household things are one of these."""

import numpy as np

from dexgrasp.shapes.solid import Solid, balls, box, ellipsoid, hull

Rng = np.random.Generator


def brick(rng: Rng) -> Solid:
    """A carton or a wooden block."""
    sides = np.sort(rng.uniform([0.025, 0.04, 0.06], [0.06, 0.09, 0.18]))
    return box(rng.permutation(sides), rng.uniform(0.001, 0.006))


def cylinder(rng: Rng) -> Solid:
    """A can."""
    radius, height = rng.uniform(0.018, 0.045), rng.uniform(0.05, 0.16)
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    edge = rng.uniform(0.001, 0.004)
    rings = [(radius - edge, height / 2), (radius - 0.29 * edge, height / 2 - 0.29 * edge), (radius, height / 2 - edge)]
    points = [(r * np.cos(turn), r * np.sin(turn), np.full(48, side * z)) for r, z in rings for side in (-1, 1)]
    solid = hull(np.hstack(points).T)
    grow = np.sqrt(2 * np.pi / 32 / np.sin(2 * np.pi / 32))
    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    part = np.vstack(
        [
            np.column_stack(
                [grow * radius * np.cos(turn), grow * radius * np.sin(turn), np.full(32, side * height / 2)]
            )
            for side in (-1, 1)
        ]
    )
    return Solid(solid.body, (part,))


def ball(rng: Rng) -> Solid:
    """A ball or a piece of fruit: an ellipsoid."""
    return ellipsoid(rng.uniform(0.025, 0.045) * rng.uniform(0.8, 1.25, size=3))


def capsule(rng: Rng) -> Solid:
    """A pill-shaped tin."""
    half = rng.uniform(0.02, 0.07)
    return balls([[0, 0, -half], [0, 0, half]], rng.uniform(0.015, 0.035))
