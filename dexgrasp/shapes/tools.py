"""Tools: handles, heads, jaws."""

import numpy as np

from dexgrasp.shapes.outline import arc, fillet
from dexgrasp.shapes.solid import Solid, balls, box
from dexgrasp.shapes.swept import tube
from dexgrasp.shapes.turned import lathe, shell

Rng = np.random.Generator


def hammer(rng: Rng) -> Solid:
    """A hammer or mallet: head across a handle."""
    grip, length = rng.uniform(0.012, 0.016), rng.uniform(0.13, 0.18)
    handle = tube([(0, 0, 0.02), (0, 0, 0.5 * length), (0, 0, length)], [grip, 0.85 * grip, 0.75 * grip], 0.85)
    reach, face = rng.uniform(0.04, 0.055), rng.uniform(0.016, 0.023)
    block = lathe(
        fillet(
            [
                (0.9 * face, -reach),
                (face, 0.002 - reach),
                (face, 0.02 - reach),
                (0.7 * face, 0.035 - reach),
                (0.7 * face, 0.0),
            ],
            0.004,
            3,
        )
    )
    if rng.random() < 0.5:
        other = lathe(
            fillet(
                [
                    (0.7 * face, -0.001),
                    (0.7 * face, reach - 0.018),
                    (face, reach - 0.012),
                    (face, reach - 0.002),
                    (0.9 * face, reach),
                ],
                0.004,
                3,
            )
        )
    else:
        peen = [(0, y, z) for y in (-0.4 * face, 0.4 * face) for z in (-0.02, 0.0)]
        tip = [(x, 0, reach) for x in (-0.7 * face, 0.7 * face)]
        other = balls(peen + tip, [0.4 * face] * 4 + [0.004] * 2)
    return handle | (block | other).at((0, 0, length), (0, 90, 0))


def screwdriver(rng: Rng) -> Solid:
    """A stout screwdriver."""
    radius, grip, blade = rng.uniform(0.014, 0.019), rng.uniform(0.08, 0.105), rng.uniform(0.06, 0.1)
    outline = [
        (0.6 * radius, 0),
        (radius, 0.012),
        (radius, 0.6 * grip),
        (0.65 * radius, 0.85 * grip),
        (0.85 * radius, 0.97 * grip),
        (0.005, grip),
    ]
    handle = lathe(fillet(outline, 0.012, 4))
    return handle | lathe([(0.0045, grip - 0.001), (0.0045, grip + blade - 0.01), (0.003, grip + blade)])


def bracket(rng: Rng) -> Solid:
    """An angle, a channel or a tee."""
    width, thick = rng.uniform(0.03, 0.05), rng.uniform(0.010, 0.016)
    base, rise = rng.uniform(0.065, 0.1), rng.uniform(0.045, 0.08)
    kind = int(rng.integers(3))
    solid = box([base, width, thick], 0.002)
    places = [[(thick - base) / 2], [(thick - base) / 2, (base - thick) / 2], [0.0]][kind]
    for place in places:
        solid |= box([thick, width, rise], 0.002).at((place, 0, (rise - thick) / 2))
    return solid


def clamp(rng: Rng) -> Solid:
    """A C-clamp with its screw."""
    gap, throat, bar = rng.uniform(0.045, 0.065), rng.uniform(0.04, 0.055), rng.uniform(0.009, 0.012)
    path = [(throat, 0, 0), (0, 0, 0), (0, 0, gap + 2 * bar), (throat, 0, gap + 2 * bar)]
    frame = tube(fillet(path, 0.018, 5), bar, rng.uniform(0.8, 1.1))
    end = gap + 2 * bar
    screw = lathe([(0.011, end - 0.026), (0.011, end - 0.02), (0.0055, end - 0.019), (0.0055, end + 0.045)])
    knob = tube([(throat - 0.022, 0, end + 0.045), (throat + 0.022, 0, end + 0.045)], 0.0065)
    return frame | screw.at((throat, 0, 0)) | knob


def brush(rng: Rng) -> Solid:
    """A dish brush or a paint brush: handle, ferrule and a block of bristles."""
    length, width = rng.uniform(0.09, 0.13), rng.uniform(0.028, 0.04)
    handle = tube(
        [(0, 0, 0), (0.0, 0.003, 0.35 * length), (0, 0, 0.75 * length), (0, 0, length)],
        [0.012, 0.015, 0.010, 0.013],
        rng.uniform(0.75, 1.0),
    )
    ferrule = box([width * 1.2, 0.028, 0.025], 0.004).at((0, 0, length + 0.012))
    flare = [(x, y, length + 0.02) for x in (-0.55 * width, 0.55 * width) for y in (-0.009, 0.009)]
    bristle = rng.uniform(0.03, 0.05)
    tips = [(1.25 * x, 1.2 * y, z + bristle) for x, y, z in flare]
    return handle | ferrule | balls(flare + tips, 0.0025)


def wrench(rng: Rng) -> Solid:
    """An open-ended spanner, thick as a toy's."""
    length, thick, gap = rng.uniform(0.1, 0.14), rng.uniform(0.018, 0.024), rng.uniform(0.012, 0.018)
    solid = box([length, 0.022, 0.8 * thick], 0.004)
    for side in (-1, 1):
        x = side * (length / 2 - 0.002)
        solid |= box([0.016, gap + 0.024, thick], 0.004).at((x, 0, 0))
        for jaw in (-1, 1):
            solid |= box([0.03, 0.013, thick], 0.004).at((x + side * 0.018, jaw * (gap + 0.013) / 2, 0))
    return solid


def flashlight(rng: Rng) -> Solid:
    """A torch: barrel and a wider head."""
    barrel, head, length = rng.uniform(0.014, 0.02), rng.uniform(0.024, 0.032), rng.uniform(0.08, 0.12)
    outline = [
        (0.85 * barrel, 0),
        (barrel, 0.004),
        (barrel, length),
        (head, length + 0.025),
        (head, length + 0.045),
        (0.93 * head, length + 0.048),
    ]
    button = balls([(barrel - 0.001, 0, 0.68 * length), (barrel - 0.001, 0, 0.68 * length + 0.012)], 0.004)
    return lathe(fillet(outline, 0.006, 4)) | button


def scoop(rng: Rng) -> Solid:
    """A flour scoop or a ladle: a cup on the end of a handle."""
    radius, wall = rng.uniform(0.03, 0.04), 0.0042
    cup = shell(fillet([(0, 0), (0.6 * radius, 0), (radius, 0.5 * radius), (radius, 1.1 * radius)], 0.02, 5), wall)
    level, reach = 1.0 * radius, rng.uniform(0.08, 0.11)
    path = [(radius - wall / 2, 0, level), (radius + 0.35 * reach, 0, level + 0.01), (radius + reach, 0, level + 0.02)]
    return cup | tube(path, [0.006, 0.0085, 0.011], 0.85, rounded=False) | balls([path[-1]], 0.0105)


def roller(rng: Rng) -> Solid:
    """A rolling pin."""
    radius, half, grip = rng.uniform(0.021, 0.03), rng.uniform(0.045, 0.06), rng.uniform(0.009, 0.012)
    end = half + rng.uniform(0.035, 0.045)
    tip = arc((0, end), 1.1 * grip, 30, 90, 6)
    upper = fillet([(radius, 0), (radius, half), (0.9 * grip, half + 0.004), tuple(tip[0])], 0.004, 3)
    upper = np.vstack([upper, tip[1:]])
    return lathe(np.vstack([upper[:0:-1] * [1, -1], upper]))
