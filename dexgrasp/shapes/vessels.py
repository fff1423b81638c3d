"""Hollow ware and bottles: thin curved walls, handles, necks."""

import numpy as np

from dexgrasp.shapes.outline import arc, fillet
from dexgrasp.shapes.solid import Solid, balls, box
from dexgrasp.shapes.swept import tube
from dexgrasp.shapes.turned import lathe, shell

Rng = np.random.Generator


def bowl(rng: Rng) -> Solid:
    """A bowl."""
    foot, rim, height = rng.uniform(0.02, 0.035), rng.uniform(0.048, 0.072), rng.uniform(0.035, 0.065)
    belly = float(rng.uniform(0.75, 0.95) * rim)
    outline = [(0.0, 0.0), (foot, 0.0), (belly, 0.4 * height), (rim, height)]
    return shell(fillet(outline, 0.03, 6), rng.uniform(0.004, 0.006))


def cup(rng: Rng) -> Solid:
    """A beaker without a handle."""
    foot, height, lean = rng.uniform(0.024, 0.036), rng.uniform(0.07, 0.12), rng.uniform(1.05, 1.35)
    return shell(fillet([(0, 0), (foot, 0), (lean * foot, height)], 0.006, 3), rng.uniform(0.003, 0.0045))


def _handle(start: float, out: float, low: float, high: float, width: float, aspect: float) -> Solid:
    """An ear in the xz plane that leaves the wall at radius `start` and reaches `out` (m) beyond it."""
    path = [(start, 0, low), (start + out, 0, low), (start + out, 0, high), (start, 0, high)]
    return tube(fillet(path, 0.02, 6), width, aspect, rounded=False, steps=12)


def mug(rng: Rng) -> Solid:
    """A mug with its handle."""
    radius, height, wall = rng.uniform(0.033, 0.044), rng.uniform(0.075, 0.11), rng.uniform(0.0038, 0.005)
    body = shell(fillet([(0, 0), (radius, 0), (radius, height)], 0.008, 3), wall)
    out, width = rng.uniform(0.028, 0.038), rng.uniform(0.0055, 0.0075)
    return body | _handle(radius - wall / 2, out, 0.24 * height, 0.8 * height, width, rng.uniform(0.7, 1.0))


def dish(rng: Rng) -> Solid:
    """A soap dish or a deep saucer: low, with a steep rim."""
    rim, height = rng.uniform(0.045, 0.062), rng.uniform(0.02, 0.035)
    return shell(fillet([(0, 0), (0.8 * rim, 0), (rim, height)], 0.012, 4), rng.uniform(0.004, 0.006))


def pan(rng: Rng) -> Solid:
    """A small saucepan with a long handle."""
    radius, height, wall = rng.uniform(0.045, 0.06), rng.uniform(0.035, 0.055), 0.0045
    body = shell(fillet([(0, 0), (radius, 0), (radius, height)], 0.01, 4), wall)
    length, level = rng.uniform(0.08, 0.11), 0.8 * height
    path = [(radius - wall / 2, 0, level), (radius + 0.03, 0, level + 0.008), (radius + length, 0, level + 0.012)]
    thick = np.array([0.007, 0.009, 0.012])
    return body | tube(path, thick, 0.8, rounded=False) | balls([path[-1]], 0.0115)


def bottle(rng: Rng) -> Solid:
    """A closed bottle with shoulder, neck and cap."""
    radius, body, neck = rng.uniform(0.026, 0.04), rng.uniform(0.075, 0.13), rng.uniform(0.011, 0.015)
    shoulder, top = body + rng.uniform(0.015, 0.035), rng.uniform(0.012, 0.025)
    waist = rng.uniform(0.84, 1.0)
    sides = [(0.85 * radius, 0), (radius, 0.01), (waist * radius, body / 2), (radius, body), (neck, shoulder)]
    outline = fillet([*sides, (neck, shoulder + top)], 0.015, 5)
    cap = arc((neck + 0.001, shoulder + top + 0.012), 0.002, 0, 90, 3)
    return lathe(np.vstack([outline, [(neck + 0.003, shoulder + top + 0.0005)], cap]))


def jar(rng: Rng) -> Solid:
    """A closed jar with a wide lid."""
    radius, height = rng.uniform(0.03, 0.042), rng.uniform(0.05, 0.09)
    body = fillet([(0.9 * radius, 0), (radius, 0.006), (radius, height), (0.82 * radius, height + 0.012)], 0.01, 4)
    lid, rise = rng.uniform(0.88, 1.0) * radius, rng.uniform(0.014, 0.022)
    top = arc((lid - 0.003, height + 0.012 + rise), 0.003, 0, 90, 3)
    return lathe(np.vstack([body, [(lid, height + 0.0125)], top]))


def vase(rng: Rng) -> Solid:
    """A bellied vase, filled."""
    belly, height = rng.uniform(0.032, 0.044), rng.uniform(0.1, 0.15)
    neck, mouth = rng.uniform(0.4, 0.6) * belly, rng.uniform(0.6, 0.85) * belly
    sides = [(0.6 * belly, 0), (1.12 * belly, 0.35 * height), (neck, 0.8 * height), (mouth, height)]
    return lathe(fillet(sides, 0.05, 8))


def wine_glass(rng: Rng) -> Solid:
    """A goblet: foot, stem and bowl."""
    foot, stem, bowl = rng.uniform(0.026, 0.034), rng.uniform(0.045, 0.07), rng.uniform(0.026, 0.036)
    low = lathe(fillet([(foot, 0), (foot, 0.003), (0.008, 0.012), (0.005, stem), (0.006, stem + 0.004)], 0.01, 4))
    outline = [(0, 0), (0.012, 0), (1.15 * bowl, 0.5 * bowl), (0.9 * bowl, 2.1 * bowl)]
    return low | shell(fillet(outline, 0.03, 6), 0.0032).at((0, 0, stem))


def spray_bottle(rng: Rng) -> Solid:
    """A bottle with a trigger head."""
    half, deep, height = rng.uniform(0.024, 0.034), rng.uniform(0.75, 1.0), rng.uniform(0.085, 0.12)
    neck = height + rng.uniform(0.025, 0.04)
    flat = [(x * (half - 0.008), y * (deep * half - 0.008)) for x in (-1, 1) for y in (-1, 1)]
    body = balls([(x, y, z) for x, y in flat for z in (0.008, height)], 0.008)
    throat = balls([(x, y, height) for x, y in flat] + [(0, 0, neck)], [0.008] * 4 + [0.013])
    grip = lathe([(0.012, height), (0.012, neck + 0.022)])
    reach = rng.uniform(0.035, 0.05)
    level = neck + 0.026
    head = balls([(-0.022, 0, level), (0.012, 0, level + 0.003), (reach, 0, level)], [0.009, 0.012, 0.008])
    trigger = tube(
        fillet([(0.02, 0, level - 0.004), (0.034, 0, level - 0.02), (0.026, 0, level - 0.045)], 0.01, 4), 0.005, 1.2
    )
    return body | throat | grip | head | trigger


def dispenser(rng: Rng) -> Solid:
    """A soap dispenser: a bottle with a pump."""
    radius, height = rng.uniform(0.027, 0.037), rng.uniform(0.07, 0.11)
    body = lathe(fillet([(0.9 * radius, 0), (radius, 0.006), (radius, height), (0.013, height + 0.014)], 0.012, 4))
    collar = lathe([(0.014, height + 0.008), (0.014, height + 0.026), (0.006, height + 0.027), (0.006, height + 0.05)])
    reach, level = rng.uniform(0.032, 0.045), height + 0.053
    nozzle = tube(
        fillet([(-0.008, 0, level), (reach - 0.01, 0, level), (reach, 0, level - 0.01)], 0.008, 3), 0.006, 1.3
    )
    return body | collar | nozzle


def watering_can(rng: Rng) -> Solid:
    """A jug with a spout and an ear."""
    radius, height, wall = rng.uniform(0.034, 0.042), rng.uniform(0.075, 0.1), 0.0045
    body = shell(fillet([(0, 0), (radius, 0), (0.85 * radius, height)], 0.012, 4), wall)
    spout = tube(
        [(-0.96 * radius, 0, 0.3 * height), (-radius - 0.025, 0, 0.65 * height), (-radius - 0.045, 0, 1.02 * height)],
        [0.011, 0.009, 0.008],
        rounded=False,
    )
    return body | spout | _handle(0.87 * radius - wall / 2 + 0.003, 0.034, 0.3 * height, 0.82 * height, 0.006, 0.9)


def teapot(rng: Rng) -> Solid:
    """A closed pot with spout, ear and lid knob."""
    radius, squat = rng.uniform(0.04, 0.05), rng.uniform(0.75, 0.95)
    side = arc((0, 0), radius, -65, 75, 16) * [1, squat]
    rise = squat * radius
    body = lathe(
        np.vstack(
            [
                side,
                fillet([(0.011, 0.99 * rise), (0.006, 1.02 * rise)], 0.003),
                arc((0, rise + 0.014), 0.010, -55, 90, 8),
            ]
        )
    )
    spout = tube(
        [(-0.9 * radius, 0, -0.3 * rise), (-radius - 0.018, 0, 0.1 * rise), (-radius - 0.032, 0, 0.7 * rise)],
        [0.012, 0.009, 0.007],
        rounded=False,
    )
    ear = _handle(0.85 * radius, 0.15 * radius + rng.uniform(0.028, 0.036), -0.45 * rise, 0.45 * rise, 0.006, 0.9)
    return body | spout | ear


def carton(rng: Rng) -> Solid:
    """A milk carton with a gable."""
    half, height, roof = rng.uniform(0.027, 0.035), rng.uniform(0.075, 0.11), rng.uniform(0.018, 0.028)
    edge = 0.002
    inset = half - edge
    square = [(x, y) for x in (-inset, inset) for y in (-inset, inset)]
    top = [(x, 0, height + roof) for x in (-inset, inset)]
    body = balls([(x, y, z) for x, y in square for z in (edge, height)], edge)
    gable = balls([(x, y, height) for x, y in square] + top, edge)
    return body | gable | box([2 * half, 0.005, 0.022], 0.002).at((0, 0, height + roof + 0.007))
