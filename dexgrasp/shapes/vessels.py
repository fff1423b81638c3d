"""Hollow ware: thin curved walls, handles."""

import numpy as np

from dexgrasp.shapes.solid import Solid, fillet, lathe, shell, tube

Rng = np.random.Generator


def bowl(rng: Rng) -> Solid:
    """A bowl."""
    foot, rim, height = rng.uniform(0.02, 0.035), rng.uniform(0.05, 0.075), rng.uniform(0.035, 0.065)
    outline = [[0, 0], [foot, 0], [rng.uniform(0.75, 0.95) * rim, 0.4 * height], [rim, height]]
    return shell(fillet(outline, 0.03, 6), rng.uniform(0.0035, 0.006))


def mug(rng: Rng) -> Solid:
    """A mug with its handle."""
    radius, height, wall = rng.uniform(0.034, 0.045), rng.uniform(0.075, 0.11), rng.uniform(0.0035, 0.005)
    body = shell(fillet([[0, 0], [radius, 0], [radius * rng.uniform(1.0, 1.12), height]], 0.01, 4), wall)
    out, low, high = rng.uniform(0.025, 0.038), 0.25 * height, 0.8 * height
    start = radius - wall / 2
    arc = fillet([[start, 0, low], [radius + out, 0, low], [radius + out, 0, high], [start, 0, high]], 0.02, 6)
    return body | tube(arc, rng.uniform(0.0045, 0.0065), rng.uniform(1.0, 1.5), rounded=False, steps=12)


def bottle(rng: Rng) -> Solid:
    """A closed bottle with shoulder, neck and cap."""
    radius, body, neck = rng.uniform(0.026, 0.042), rng.uniform(0.08, 0.14), rng.uniform(0.011, 0.016)
    shoulder, top = body + rng.uniform(0.015, 0.04), rng.uniform(0.02, 0.04)
    waist = rng.uniform(0.8, 1.0)
    outline = [
        [0.8 * radius, 0],
        [radius, 0.01],
        [waist * radius, body / 2],
        [radius, body],
        [neck, shoulder],
        [neck, shoulder + top],
    ]
    return lathe(fillet(outline, 0.015, 5))
