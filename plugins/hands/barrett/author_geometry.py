"""Author the BarrettHand's geometry: solids from a few measured figures, millimetres, in link coordinates.

No vertex comes from anyone's mesh: profiles are lines, circles and their convex hulls, cut and joined. `solids` gives
what one sees, `convex_parts` what collides; `author_urdf.py` writes both. Sections of the links in their own frames:
the base as in the maker's manual (finger 3 at +y), fingers along -x with +y on the closing side.
"""

from collections.abc import Sequence

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType
from numpy.typing import NDArray

Points = NDArray[np.float64]
DECK = {"280": 41.5, "282": 25.2}
"""Height of the spread joints on the can."""
FACE = {"280": 79.3, "282": 60.0}
"""Height of the palm's face."""
HUB = np.zeros(2)
OUTER_JOINT = np.array([-69.936, 3.0])
TIP, TIP_RADIUS = np.array([-36.8677, 30.7376]), 9.55
TIP_MIDDLE, TIP_HALF_WIDTH = 0.6, 11.5
"""The fingertip body's middle plane lies off the joint's; half its width."""
FILLET, CROWN = 4.0, 42.0
"""Radius of the fingertip's long edges, and of the crown across its pad."""
SLOT = (-4.3, 2.7)
"""Slot of a knuckle for the inner link, along the joint axis."""


def disc(center: Points, radius: float, start: float = 0.0, stop: float = 360.0, step: float = 8.0) -> Points:
    """Return points of an arc, degrees, at most `step` apart."""
    angles = np.radians(np.linspace(start, stop, int(np.ceil((stop - start) / step)) + 1))
    return center + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def hull(*points: Sequence[Sequence[float]] | Points) -> CrossSection:
    """Return the convex profile round some points."""
    return CrossSection.hull_points(np.vstack([np.asarray(group, dtype=float) for group in points]))


def prism(profile: CrossSection, low: float, high: float, bevel: float = 0.0) -> Manifold:
    """Return a convex profile drawn from `low` to `high` along z, its edges bevelled."""
    levels = [(low, bevel), (low + bevel, 0.0), (high - bevel, 0.0), (high, bevel)] if bevel else [(low, 0), (high, 0)]
    return loft([(profile.offset(-inset, JoinType.Miter).to_polygons()[0], level) for level, inset in levels])


def loft(layers: Sequence[tuple[Points, float]]) -> Manifold:
    """Return the convex hull of outlines at heights."""
    return Manifold.hull_points(np.vstack([np.column_stack([p, np.full(len(p), z)]) for p, z in layers]))


def upright(solid: Manifold) -> Manifold:
    """Turn a solid drawn along z in the (x, z) plane of a knuckle so that it extends along y."""
    return solid.rotate([90, 0, 0])


def knuckle_head(slim: bool = False) -> tuple[Manifold, Manifold]:
    """Return head of a knuckle (frame of the spread joint), and what is cut from it: slot and cable bores.

    The `slim` head is that of the BH8-282's fixed knuckle, which has no bores.
    """
    joint = np.array([-50.0, 33.9])
    foot = [(-27, 24.8), (-27, 0), (-50, 0.3), (-63.3, 7.2), (-65, 10)]
    radius, floor = 15.0, [(-70.0, 22.0), (-30.5, 30.8)]
    if slim:
        foot[2:], radius, floor = [(-44.7, 0), (-60.3, 8.7), (-62.5, 11.5)], 13.0, [(-70.0, 16.0), (-35.0, 16.0)]
    head = upright(prism(hull(disc(joint, radius), foot), -12.3, 12.3, 1.3))
    room = hull(disc(joint, 14.0), [floor[0], (-70, 60), (floor[1][0], 60), floor[1]])
    if slim:
        return head, upright(prism(room, -SLOT[1], -SLOT[0]))
    cable = Manifold.cylinder(25, 3.2, 3.2, 24).rotate([0, -90, 0]).translate([-41, -0.8, 4])
    for y in (-6.3, 4.7):
        cable += Manifold.cylinder(27, 1.2, 1.2, 12).rotate([0, -90, 0]).translate([-39, y, 16.6])
    return head, upright(prism(room, -SLOT[1], -SLOT[0])) + cable


def knuckle_arm(step: float) -> Manifold:
    """Return the arm of a knuckle round its spread axis."""
    return prism(hull(disc(HUB, 12.3, step=step), [(-30, -12.3), (-30, 12.3)]), 0.0, 24.8)


def plate_outline(inset: float) -> Points:
    """Return the palm plate: disc and strip, corners rounded."""
    whole = CrossSection([disc(HUB, 44.5, step=6)[:-1]]) ^ CrossSection.square([100, 53], True)
    rounded = whole.offset(-11, JoinType.Round, circular_segments=40).offset(11, JoinType.Round, circular_segments=40)
    return np.asarray(rounded.offset(-inset, JoinType.Miter).simplify(0.05).to_polygons()[0])


def palm_plate(bottom: float, top: float) -> Manifold:
    """Return the plate under the palm's face, slightly domed, its rim chamfered."""
    dome = [(plate_outline(3.0), top - 1.0), (plate_outline(3.0) * 0.5, top - 0.3), (plate_outline(3.0) * 0.2, top)]
    return loft([(plate_outline(0.6), bottom), (plate_outline(0), bottom + 0.6), (plate_outline(0), top - 3.5), *dome])


def base_parts(model: str) -> list[Manifold]:
    """Return can, web, plate and finger 3's knuckle of the base, all convex."""
    deck, face = DECK[model], FACE[model]
    rim, under, back, front = {"280": (6.0, 66.3, -42.0, 30.0), "282": (8.0, 50.0, -35.0, 35.0)}[model]
    can = loft([(disc(HUB, r, step=6)[:-1], z) for r, z in [(44.4, rim), (44.5, deck - 1.3), (43.2, deck)]])
    flange = loft([(disc(HUB, 42.8, step=6)[:-1], z) for z in (0.0, rim)])
    top = face - 8.7
    shoulder = [(back, top - 3), (back + 2, top - 0.4), (-32, top + 1), (-23, face - 2)]
    web = hull([(back, deck - 1), (front, deck - 1), (front, under + 1)], shoulder)
    stand = prism(web, -12.3, 12.3).rotate([90, 0, 90])  # drawn in (x, y), meant in (y, z)
    head, _ = placed_knuckle(model)
    return [can, flange, stand, palm_plate(under, face), head]


def placed_knuckle(model: str) -> tuple[Manifold, Manifold]:
    """Return finger 3's knuckle head and slot in the base frame."""
    parts = knuckle_head(slim=model == "282")
    head, room = (part.rotate([0, 0, -90]).translate([0, 0, DECK[model]]) for part in parts)
    return head, room


def base(model: str) -> Manifold:
    """Return the palm: parts joined; finger 3's slot and screw holes cut, and the 280's bores, socket and plug."""
    solid = Manifold.batch_boolean(base_parts(model), OpType.Add)
    bores = [Manifold.cylinder(6, 9.3, 9.3, 40).translate([x, 0, DECK[model] - 5]) for x in (-25, 25)]
    _, room = placed_knuckle(model)
    socket = Manifold.cube([13, 8, 4.3]).translate([-6.5, -46, 10.9])
    plug = Manifold.cube([11, 5, 12], True)
    screws = [Manifold.cylinder(9, 1.3, 1.3, 12).rotate([0, 0, turn]).translate(
        [30 * np.cos(np.radians(turn)), 30 * np.sin(np.radians(turn)), 0]) for turn in (0, 90, 180, 270)]  # fmt: skip
    cut = [*bores, *screws, room, socket, plug] if model == "280" else [*screws, room]
    return Manifold.batch_boolean([solid, *cut], OpType.Subtract)


def knuckle() -> Manifold:
    """Return the knuckle of fingers 1 and 2 (frame of the spread joint)."""
    head, room = knuckle_head()
    boss = Manifold.cylinder(35, 9, 9, 40).translate([0, 0, -5])
    return (head + knuckle_arm(9) - room) + boss


def inner_plate(step: float = 8.0) -> Manifold:
    """Return the bar of the inner link from joint to joint."""
    return prism(hull(disc(HUB, 12.5, step=step), disc(OUTER_JOINT, 9.5, step=step)), -2.2, 4.6)


def inner_body(levels: Sequence[float]) -> Manifold:
    """Return the drive housing on the inner link; `levels` are the angles (deg) at which its edge is drawn."""
    outline = hull([(-58.9, -5), (-57.4, -7.3), (-19, -10.7), (-16.8, -9.3), (-15.9, -4), (-16, 8.5), (-18.3, 11.3)],
                   [(-24.3, 14.8), (-26, 15), (-55, 15), (-57.6, 13.6), (-58.5, 11)])  # fmt: skip
    layers = []
    for angle in np.radians(levels):
        inset = 4.0 * (1 - np.sin(angle))
        points = np.asarray(outline.offset(-inset, JoinType.Miter).to_polygons()[0])
        layers += [(points, 10.5 - 4.0 * (1 - np.cos(angle))), (points, -9.1 + 4.0 * (1 - np.cos(angle)))]
    return loft(layers)


def inner_hub(segments: int) -> Manifold:
    """Return the drum at the inner joint."""
    return Manifold.cylinder(21, 10, 10, segments).translate([0, 0, -9.7])


def inner() -> Manifold:
    """Return the inner link."""
    axle = Manifold.cylinder(17.6, 5, 5, 24).translate([*OUTER_JOINT, -9.2])
    return inner_plate() + inner_body((0, 30, 60, 90)) + inner_hub(48) + axle


def outer_outline(across: float, inset: float, step: float, hub: bool = True) -> Points:
    """Return the fingertip's side view at a distance from its middle plane, edges inset.

    Fingertip circle, a pad of radius 116 tangent to it 79 deg from the tip direction, a tangent to the hub, and a
    straight back tangent to the hub that cuts the tip.
    """
    crown = across**2 / (2 * CROWN)
    back = np.radians(225.05)
    cut = np.array([np.cos(back), np.sin(back)])
    edge = np.degrees(np.arccos((9.5 - inset - cut @ TIP) / (TIP_RADIUS - crown - inset)))
    end = 61.0
    tip = disc(TIP, TIP_RADIUS - crown - inset, end, 225.05 - edge, step)
    center = TIP - (116.0 - TIP_RADIUS) * np.array([np.cos(np.radians(end)), np.sin(np.radians(end))])
    pad = disc(center, 116.0 - crown - inset, 45.4, end, 4.0)[:-1]
    return np.vstack([tip, pad, disc(HUB, 9.5 - inset, -135, 45.4, 18.0)] if hub else [tip, pad])


def outer_body(heights: Sequence[float], angles: Sequence[float], step: float) -> Manifold:
    """Return the outer link's convex body from outlines at +-`heights` and on its rounded edge, there half as fine.

    A flat wall touches a facet at one of its ends: `step` (deg) sets how far that is from where an arc would touch.
    """
    flat = TIP_HALF_WIDTH - FILLET
    layers = [(height, 0.0, False) for height in heights] + [(flat, 0.0, True)]
    layers += [(flat + FILLET * np.sin(a), FILLET * (1 - np.cos(a)), True) for a in np.radians(angles)]
    outlines = []
    for across, inset, rim in layers:
        outline = outer_outline(across, inset, 2 * step if rim else step, rim)
        outlines += [(outline, TIP_MIDDLE + side * across) for side in (-1, 1)]
    return loft(outlines)


def outer() -> Manifold:
    """Return the outer link: body, fork round the inner link's end (up to 10.05 from the joint), back cover, nail."""
    body = outer_body((0.6, 2.5, 5), (35, 65, 90), 4.0)
    fork = Manifold.cube([60, 80, 8]).translate([-49.95, -40, -2.4]).rotate([0, 0, 140.18])
    cover = Manifold.cube([22, 3, 15]).translate([-11, -1.5, TIP_MIDDLE - 7.5]).rotate([0, 0, 135.05])
    nail = prism(hull([(-47.7, 34.9), (-47.1, 35.6), (-44.5, 33.6), (-41.0, 28.5), (-41.4, 27.9)]), -7.6, 8.8)
    return body - fork - cover.translate([-29.2, 15.7, 0]) + nail


def convex_parts(model: str) -> dict[str, list[Manifold]]:
    """Return the convex collision parts of each kind of link."""
    _, _, web, plate, head = base_parts(model)
    can = loft([(disc(HUB, 44.6, step=15)[:-1], z) for z in (0.0, DECK[model])])
    return {
        f"base_{model}": [can, web, plate, head],
        "knuckle": [knuckle_arm(18), knuckle_head()[0]],
        "inner": [inner_plate(18), inner_body((0, 45, 90)), inner_hub(20)],
        "outer": [outer_body((0.6, 4), (45, 90), 4.0)],
    }


def solids(model: str) -> dict[str, Manifold]:
    """Return the visible solid of each kind of link."""
    return {f"base_{model}": base(model), "knuckle": knuckle(), "inner": inner(), "outer": outer()}
