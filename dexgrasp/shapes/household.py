"""Fruit, toys and gadgets."""

import numpy as np

from dexgrasp.shapes.outline import arc, fillet
from dexgrasp.shapes.solid import Solid, balls, box, ellipsoid, hull, octasphere
from dexgrasp.shapes.swept import tube
from dexgrasp.shapes.turned import lathe, shell

Rng = np.random.Generator


def bulb(rng: Rng) -> Solid:
    """A lamp bulb."""
    radius, cap = rng.uniform(0.026, 0.036), rng.uniform(0.012, 0.015)
    globe = arc((0, 0.062 + 0.6 * radius), radius, -42, 90, 14)
    return lathe(
        np.vstack([fillet([(0.6 * cap, 0), (cap, 0.006), (cap, 0.028), tuple(globe[0])], 0.012, 5), globe[1:]])
    )


def banana(rng: Rng) -> Solid:
    """A bent tapering bar."""
    bend, thick = rng.uniform(0.07, 0.13), rng.uniform(0.016, 0.021)
    spread = np.degrees(rng.uniform(0.12, 0.17) / bend)
    line = arc((0, 0), bend, 90 - spread / 2, 90 + spread / 2, 24)
    along = np.linspace(-1, 1, 25)
    radii = thick * (1 - 0.62 * np.abs(along) ** 3.5)
    return tube(np.column_stack([line[:, 0], np.zeros(25), line[:, 1]]), radii, rng.uniform(0.88, 1.0))


def apple(rng: Rng) -> Solid:
    """An apple: dimples above and below, a stalk."""
    radius, tall = rng.uniform(0.03, 0.04), rng.uniform(0.85, 1.0)
    turn = np.radians(np.linspace(-90, 90, 41))
    swell = radius * (1 - 0.28 * np.abs(np.sin(turn)) ** 9)
    line = np.column_stack([swell * np.cos(turn) + 0.0, tall * swell * np.sin(turn)])
    rising = np.maximum.accumulate(line[:, 1]) <= line[:, 1]
    line = line[rising & (line[:, 1] >= -line[:, 1].max())]
    stalk = tube([(0, 0, 0.5 * radius), (0.002, 0, tall * radius)], 0.0035)
    return lathe(line) | stalk


def pear(rng: Rng) -> Solid:
    """A pear or a gourd."""
    low, high, rise = rng.uniform(0.031, 0.038), rng.uniform(0.014, 0.02), rng.uniform(0.045, 0.06)
    bottom, top = arc((0, 0), low, -90, 25, 14), arc((0, rise), high, 5, 90, 8)
    joint = fillet([tuple(bottom[-1]), (1.02 * high, 0.72 * rise), tuple(top[0])], 0.03, 6)
    return lathe(np.vstack([bottom[:-1], joint, top[1:]]))


def figure(rng: Rng) -> Solid:
    """A toy figure: legs, body, arms and a head."""
    tall, wide = rng.uniform(0.9, 1.15), rng.uniform(0.9, 1.15)
    legs = [
        balls([(side * 0.016 * wide, 0, 0.011), (side * 0.016 * wide, 0, 0.045 * tall)], 0.0105) for side in (-1, 1)
    ]
    chest = 0.085 * tall
    body = balls(
        [(x * wide, 0, z) for x, z in ((-0.014, 0.05 * tall), (0.014, 0.05 * tall), (-0.018, chest), (0.018, chest))],
        0.014,
    )
    raise_ = rng.uniform(-0.03, 0.03)
    arms = [
        tube([(side * 0.02 * wide, 0, chest), (side * 0.055 * wide, 0, chest + side * raise_)], 0.0085)
        for side in (-1, 1)
    ]
    head = ellipsoid([0.019, 0.018, 0.021]).at((0, 0, chest + 0.03))
    solid = legs[0] | legs[1] | body | arms[0] | arms[1] | head
    return solid


def controller(rng: Rng) -> Solid:
    """A game controller: a body with two grips and two sticks."""
    half, grip = rng.uniform(0.034, 0.044), rng.uniform(0.04, 0.055)
    body = balls([(x * half, y, 0) for x in (-1, 1) for y in (-0.014, 0.016)], 0.0135)
    solid = body
    for side in (-1, 1):
        solid |= tube(
            [(side * half, 0.004, 0), (side * (half + 0.012), -0.02, -0.003), (side * (half + 0.016), -grip, -0.008)],
            [0.0155, 0.0145, 0.0125],
        )
        solid |= lathe([(0.005, 0), (0.005, 0.019), (0.0085, 0.02), (0.0085, 0.024)]).at((side * 0.02, -0.012, 0))
    return solid


def mouse(rng: Rng) -> Solid:
    """A computer mouse, or a stone."""
    long, wide, high = rng.uniform(0.09, 0.115), rng.uniform(0.052, 0.064), rng.uniform(0.032, 0.042)
    dome = octasphere(14) * [long / 2, wide / 2, 0.75 * high]
    return hull(np.column_stack([dome[:, :2], np.maximum(dome[:, 2], -0.25 * high)]))


def stapler(rng: Rng) -> Solid:
    """A stapler: a base and an arm that meet behind."""
    long, wide, lift = rng.uniform(0.1, 0.14), rng.uniform(0.026, 0.036), rng.uniform(0.026, 0.036)
    base = box([long, wide, 0.014], 0.004).at((0, 0, 0.007))
    y = wide / 2 - 0.007
    arm = balls(
        [
            (x, t, z)
            for t in (-y, y)
            for x, z in ((-0.5 * long + 0.01, 0.022), (-0.42 * long, 0.032), (0.48 * long, lift + 0.004))
        ],
        0.007,
    )
    hinge = box([0.03, 0.9 * wide, 0.02], 0.003).at((-0.5 * long + 0.018, 0, 0.015))
    return base | hinge | arm


def car(rng: Rng) -> Solid:
    """A toy car."""
    half, wide, roof = rng.uniform(0.045, 0.06), rng.uniform(0.036, 0.046), rng.uniform(0.018, 0.026)
    body = box([2 * half, wide, 0.024], 0.006).at((0, 0, 0.022))
    y = wide / 2 - 0.009
    cab = balls(
        [
            (x, t, z)
            for t in (-y, y)
            for x, z in (
                (-0.5 * half, 0.03),
                (0.5 * half, 0.03),
                (-0.32 * half, 0.026 + roof),
                (0.2 * half, 0.026 + roof),
            )
        ],
        0.006,
    )
    solid = body | cab
    wheel = lathe(fillet([(0.011, -0.006), (0.0125, -0.005), (0.0125, 0.005), (0.011, 0.006)], 0.002, 2))
    for x in (-0.6 * half, 0.6 * half):
        for side in (-1, 1):
            solid |= wheel.at((x, side * (wide / 2 + 0.001), 0.0125), (90, 0, 0))
    return solid


def camera(rng: Rng) -> Solid:
    """A camera: body, lens barrel, finder."""
    long, high, deep = rng.uniform(0.09, 0.12), rng.uniform(0.06, 0.075), rng.uniform(0.03, 0.04)
    lens, reach = rng.uniform(0.02, 0.027), rng.uniform(0.025, 0.045)
    body = box([long, deep, high], 0.005) | box([0.035, 0.8 * deep, 0.016], 0.004).at((0, 0, high / 2 + 0.004))
    barrel = lathe(fillet([(lens, 0), (lens, 0.7 * reach), (1.1 * lens, 0.75 * reach), (1.1 * lens, reach)], 0.003, 3))
    return body | barrel.at((0.1 * long, -deep / 2 + 0.001, -0.003), (90, 0, 0))


def plane(rng: Rng) -> Solid:
    """A toy aeroplane."""
    half, wing = rng.uniform(0.055, 0.075), rng.uniform(0.05, 0.065)
    body = tube(
        [(-half, 0, 0.006), (-0.2 * half, 0, 0), (0.6 * half, 0, 0), (half, 0, 0)], [0.009, 0.018, 0.019, 0.014]
    )
    wings = balls(
        [(x, side * wing, 0) for side in (-1, 1) for x in (-0.012, 0.012)] + [(-0.018, 0, 0), (0.022, 0, 0)], 0.005
    )
    tail = balls([(-half, side * 0.03, 0.006) for side in (-1, 1)] + [(0.02 - half, 0, 0.006)], 0.004)
    fin = balls([(-half, 0, 0.006), (0.024 - half, 0, 0.006), (-half - 0.004, 0, 0.036)], 0.004)
    return body | wings | tail | fin


def bell(rng: Rng) -> Solid:
    """A hand bell: a flared cup under a handle."""
    rim, height = rng.uniform(0.032, 0.042), rng.uniform(0.045, 0.06)
    outline = fillet([(0, 0), (0.4 * rim, 0), (0.7 * rim, 0.6 * height), (rim, height)], 0.02, 5)
    grip = rng.uniform(0.05, 0.07)
    handle = lathe(
        fillet(
            [
                (0.007, -0.002),
                (0.007, 0.012),
                (0.014, 0.5 * grip),
                (0.009, 0.85 * grip),
                (0.012, 0.95 * grip),
                (0.006, grip),
            ],
            0.012,
            4,
        )
    )
    return shell(outline, 0.0042).at((0, 0, 0), (180, 0, 0)) | handle
