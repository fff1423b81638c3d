"""Author the 3-finger gripper's geometry: convex solids from a few measured figures, millimetres, in link coordinates.

Outlines are side views in the (x, y) plane of a finger's links (x along the link at zero, +y the closing side), rounded
to half millimetres; a solid is the hull of a broad outline near its middle plane and a narrower one at its sides.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

Points = Sequence[tuple[float, float]] | NDArray[np.float64]
HALF_WIDTH, INNER = 15.4, 9.0
"""Half width of the fingers, and up to where their outline is full."""
TILT = 0.52
"""By how much joint 2 is turned at zero, rad; the fingertip's own axis is turned back by it."""


def disc(center: tuple[float, float], radius: float, start: float = 0.0, stop: float = 360.0) -> NDArray[np.float64]:
    """Return points of an arc, degrees, about 12 apart."""
    angles = np.radians(np.linspace(start, stop, int(np.ceil((stop - start) / 12)) + 1))
    return np.array(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def solid(*layers: tuple[Points, float], both: bool = True) -> trimesh.Trimesh:
    """Return the hull of outlines at heights z, and with `both` at -z."""
    points = [np.column_stack([np.asarray(outline), np.full(len(outline), z)]) for outline, z in layers]
    points += [layer * [1, 1, -1] for layer in points] if both else []
    return trimesh.convex.convex_hull(np.vstack(points))


def turned(outline: Points, angle: float) -> NDArray[np.float64]:
    """Return an outline turned about the origin."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(outline) @ np.array([[cosine, sine], [-sine, cosine]])


def palm() -> trimesh.Trimesh:
    """Return the housing: layers along +y (out of the palm), each an outline in (x, z)."""
    sides = [(62.5, 33.0), (56.0, 46.0), (48.5, 53.5), (36.0, 59.0), (-12.5, 62.5), (-42.5, 61.5), (-57.0, 51.0)]
    rim = [(62.5, 42.5), (57.0, 54.0), (47.0, 60.0), (-17.0, 65.0), (-50.0, 64.5), (-57.0, 61.0), (-66.0, 35.0)]
    neck = [(63.0, 13.5), (60.0, 42.0), (50.5, 56.0), (42.0, 58.5), (-19.5, 62.5), (-43.0, 61.5), (-63.0, 44.0)]
    face = [(51.0, 41.5), (48.5, 46.0), (44.0, 49.0), (-17.0, 53.5), (-54.0, 10.0)]
    layers = [(disc((0, 0), 22.0), -54.0), (disc((0, 0), 54.3), -40.0), ([*sides, (-70.0, 14.0)], -10.0),
              (rim, 0.0), (rim, 19.0), (neck, 25.0), (face, 50.8)]  # fmt: skip
    hull = solid(
        *[(np.vstack([outline, np.asarray(outline) * [1, -1]]), level) for outline, level in layers], both=False
    )
    hull.vertices = np.asarray(hull.vertices)[:, [0, 2, 1]]  # drawn upwards along z, meant along y
    hull.invert()
    return hull


def link_0() -> trimesh.Trimesh:
    """Return the knuckle, which the scissor motion turns about its y axis."""
    front = [(26.5, 22.0), (26.0, -9.0), (24.5, -11.5), (12.5, -14.0)]
    round_ = disc((-1.5, 0.0), HALF_WIDTH, 90, 270)  # in (x, z)
    body = [np.column_stack([round_[:, 0], np.full(len(round_), y), round_[:, 1]]) for y in (-14.3, 22.0)]
    crown = [(x, 30.0, z) for x in (-12.0, 13.0) for z in (-8.0, 8.0)]
    sides = [(x, y, z) for x, y in front for z in (-HALF_WIDTH, HALF_WIDTH)]
    return trimesh.convex.convex_hull(np.vstack([*body, crown, sides]))


def link_1() -> trimesh.Trimesh:
    """Return the proximal phalanx, from joint 1 (origin) to joint 2 at (50, -28)."""
    full = [(2.0, 11.8), (-3.0, 11.5), (7.0, 10.0), (55.5, -24.5), (65.5, -51.5), (54.5, -55.5), (42.5, -55.0)]
    back = [(-16.5, -28.5), (-25.5, -21.5), (-30.5, -13.0), (-30.5, -8.5), (-27.5, -3.0)]
    side = [(7.0, -3.5), (8.0, -11.0), (52.0, -36.5), (56.0, -29.5), (54.5, -23.5), (21.0, -2.5), (14.0, 0.0)]
    return solid(([*full, *back], INNER), (side, HALF_WIDTH))


def link_2() -> trimesh.Trimesh:
    """Return the middle phalanx, from joint 2 (origin) to joint 3 at (39, 0)."""
    full = [(11.0, 7.5), (29.5, 7.5), (42.0, 5.5), (45.0, 2.5), (48.0, -12.5), (46.0, -16.0), (5.0, -27.5)]
    back = [(-4.5, -27.5), (-10.5, -25.5), (-16.0, -22.5), (-20.5, -18.0), (-24.0, -12.5), (-2.0, 5.5)]
    side = [(7.5, 6.5), (7.5, -6.5), (44.5, -6.5), (45.5, 1.0), (42.5, 5.0), (29.5, 7.5), (11.0, 7.5)]
    return solid(([*full, *back], INNER), (side, HALF_WIDTH))


def link_3() -> trimesh.Trimesh:
    """Return the fingertip, drawn along its own axis: joint 3 at the origin, pad at y = 8, tip at x = 38."""
    tip = [(38.0, 3.0), (38.0, 7.0), (37.0, 8.0)]
    full = [(12.5, 8.0), (-2.0, 6.0), (-17.5, -1.0), (-16.0, -8.0), (-11.5, -14.0), (-6.5, -16.5), (0.5, -17.5)]
    side = [(12.5, 8.0), (4.5, 6.5), (10.0, -8.5), (12.0, -9.0), (18.5, -6.5), (18.5, 8.0)]
    layers = [(full, INNER), (tip, 8.0), ([(36.5, 4.0), (36.5, 8.0)], 12.7), (side, HALF_WIDTH)]
    return solid(*[(turned(outline, TILT), level) for outline, level in layers])


def solids() -> dict[str, trimesh.Trimesh]:
    """Return the solid of each kind of link, millimetres."""
    return {"palm": palm(), "link_0": link_0(), "link_1": link_1(), "link_2": link_2(), "link_3": link_3()}
