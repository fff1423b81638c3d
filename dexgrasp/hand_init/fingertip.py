"""The fingertip of a finger as the contact representation wants it: circle, closing axis, mid-plane."""

import contextlib
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from dexgrasp.ball_tree import planes
from dexgrasp.doctor.solid import outside, way_out
from dexgrasp.errors import DexgraspError
from dexgrasp.fingertip import fit_fingertip
from dexgrasp.hand_init.fingers import FingerGuess, middle
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Model

FLAT, FACING, TOUCHING = 0.012, 0.8, 6e-4
"""A pad is flat where a side of the outline is so long (m) and faces the closing direction; a circle touches it, m."""
BESIDE = 0.006
"""A round tip that goes over into a flat side touches that at its end, or so far beside it, m."""
NEAR = 0.015
"""The pad begins this near to where the fitted circle would touch, m."""
AWAY = 0.016
"""It is not so far from the fitted circle, m."""
PAD = 0.008
"""Largest circle in a flat pad, and how far from its end it touches, m."""
LOOSE = 0.002
"""A circle that is farther off what collides is none, m."""
REACH = 0.03
"""Distance from the tip's centre to the virtual outer joint of a slide, m (METHOD section 1)."""


@dataclass
class Fingertip:
    """In the distal link's coordinates, m."""

    radius: float
    center: Float[ndarray, "3"]
    axis: Float[ndarray, "3"]
    """Turning about it presses the tip into the object."""
    joint: Float[ndarray, "3"]
    """The outer joint, in the plane of the circle."""
    told: tuple[str, ...] = ()
    """Keys that the YAML must tell: what `UrdfHand` takes by itself would be another."""


def find_fingertip(model: Model, finger: FingerGuess, approach: np.ndarray, guesses: Guesses) -> Fingertip:
    """Fit the fingertip's circle; `approach` is the palm's direction in root coordinates."""
    poses = model.poses(middle(model))
    root_T_link = poses[finger.link][0]
    link_T_joint = np.linalg.inv(root_T_link) @ poses[finger.last.child][0]
    origin, slide = link_T_joint[:3, 3], link_T_joint[:3, :3] @ finger.last.axis
    tip = link_T_joint[:3, :3] @ finger.tip + origin
    mesh = model.links[finger.link].mesh
    assert mesh is not None
    velocity = _velocity(model, finger, tip)
    topic, distal = f"fingers.{finger.name}.tip", None
    told: tuple[str, ...] = ()
    if finger.last.kind == "prismatic":
        direction = slide * np.sign(slide @ velocity)
        distal = root_T_link[:3, :3].T @ approach
        distal = distal - (distal @ direction) * direction
        if np.linalg.norm(distal) < 0.3:
            distal = tip - origin - ((tip - origin) @ direction) * direction
        distal /= np.linalg.norm(distal)
        axis = np.cross(distal, direction)
    else:
        spoke = tip - origin - ((tip - origin) @ slide) * slide
        axis = slide * (np.sign(np.cross(slide, spoke) @ velocity) or 1.0)
        # What `UrdfHand` takes without being told: the sign in which closing turns the last joint.
        lead = model.driver(finger.last.name)
        turns = lead.rate * finger.closing.get(lead.joint, 0.0)
        if (turns < 0) != (axis @ slide < 0):
            told = ("closing_axis",)
            guesses.add(topic, "the last joint turns outwards while the finger closes: a linkage; axis told", "likely")
    try:
        center, radius = fit_fingertip(mesh, origin, axis, distal)
    except DexgraspError:
        center, radius, told = tip - 0.008 * _unit(tip - origin), 0.008, ("tip_radius", "tip_center", *told)
        guesses.add(topic, "no circle could be fitted: 8 mm at the end of the mesh was taken; look at it", "UNSURE")
    pad = np.cross(axis, _unit(center - origin)) if distal is None else direction
    parts = model.links[finger.link].parts
    off = _off(parts, center, radius, axis, pad)
    flat = _on_pad(parts, center, radius, axis, pad)
    if flat is None and off > LOOSE:
        reach = way_out(parts, center, pad)
        text = f"the circle of {radius * 1e3:.1f} mm is {off * 1e3:.1f} mm off what collides; look at it"
        guesses.add(topic, text, "UNSURE")
        if reach > LOOSE:
            radius, told = reach, ("tip_radius", "tip_center", *told)
    if flat is not None:
        (center, radius), told = flat, ("tip_radius", "tip_center", *told)
        text = f"the pad is flat: a circle of {radius * 1e3:.1f} mm that touches it near its end"
        guesses.add(topic, text, "likely")
    plane = origin + ((center - origin) @ axis) * axis
    if abs((plane - origin) @ axis) > 1e-6:
        aside = abs((plane - origin) @ axis) * 1e3
        guesses.add(topic, f"the tip's middle lies {aside:.1f} mm aside of the joint's origin: cut there", "likely")
    outer = center - REACH * _unit(direction + distal) if distal is not None else plane
    _judge(mesh, plane, center, radius, axis, outer, topic, guesses)
    return Fingertip(radius, center, axis, outer, told)


def _off(
    parts: tuple[trimesh.Trimesh, ...], center: np.ndarray, radius: float, axis: np.ndarray, pad: np.ndarray
) -> float:
    """Return how far the circle is off what collides where it is nearest, from the pad's direction to the tip's, m."""
    if not parts or outside(parts, center[None])[0] > 0:
        return radius if parts else 0.0
    across, end = pad, np.cross(pad, axis)
    angles = np.radians([0.0, 15.0, 30.0, 45.0, 60.0])
    ways = [np.cos(angle) * across + np.sin(angle) * end for angle in angles]
    return min(abs(way_out(parts, center, way) - radius) for way in ways)


def _on_pad(
    parts: tuple[trimesh.Trimesh, ...], center: np.ndarray, radius: float, axis: np.ndarray, pad: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Return a circle that touches the flat pad of what collides; None without one, or where the given circle does."""
    across = _unit(pad - (pad @ axis) * axis)
    along = np.cross(across, axis)
    # The part that holds the circle's middle: a hull over several would have sides that nothing has.
    depths = [float((side[:, :3] @ center - side[:, 3]).max()) for side in map(planes, parts)]
    every, parts = parts, parts[int(np.argmin(depths)) :][:1] if depths else ()
    cuts = [trimesh.intersections.mesh_plane(part, axis, center + 1e-7 * axis).reshape(-1, 3) for part in parts]
    points = np.vstack([np.zeros((0, 3)), *cuts]) - center
    if len(points) < 4:
        return None
    try:
        outline = (points @ np.stack([along, across], axis=1))[
            ConvexHull(points @ np.stack([along, across], axis=1)).vertices
        ]
    except QhullError:
        return None
    ends = np.roll(outline, -1, axis=0)  # counter-clockwise: the outside is on the right
    sides = ends - outline
    length = np.linalg.norm(sides, axis=1)
    outwards = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
    facing = (outwards[:, 1] > FACING) & (length > FLAT)
    if not facing.any():
        return None
    side = int(np.where(facing, length, 0.0).argmax())
    normal, start, stop = outwards[side], outline[side], ends[side]
    low, high = sorted((start[0], stop[0]))
    if abs(start @ normal - radius) < TOUCHING and low - BESIDE < radius * normal[0] < high + BESIDE:
        return None
    # The end of the pad is that which is nearer to the fitted circle, which is at the finger's end.
    if np.linalg.norm(start - radius * normal) < np.linalg.norm(stop - radius * normal):
        start, stop = stop, start
    if np.linalg.norm(stop - radius * normal) > NEAR:
        return None  # farther up the finger
    way = (start - stop) / length[side]
    thick = float(np.ptp(outline @ normal))
    if radius > 0.93 * thick / 2:
        return None  # a round tip: its circle is as thick as the finger
    new = min(PAD, thick / 2)
    middle = stop + min(PAD, length[side] / 2) * way - new * normal
    touch = center + (middle[0] + new * normal[0]) * along + (middle[1] + new * normal[1]) * across
    buried = min(float((each[:, :3] @ touch - each[:, 3]).max()) for each in map(planes, every)) < -TOUCHING
    if buried or np.linalg.norm(middle) > AWAY:
        return None  # a seam between parts, or the side of a finger with a round end
    return center + middle[0] * along + middle[1] * across, new


def _velocity(model: Model, finger: FingerGuess, tip: np.ndarray) -> np.ndarray:
    """Return how the tip moves when the finger closes, in the coordinates of its link in mid-posture."""
    start = middle(model)
    step = {joint: start[joint] + 1e-6 * rate for joint, rate in finger.closing.items()}
    before, after = (model.poses({**start, **values})[finger.link][0] for values in ({}, step))
    moved = (after[:3, :3] - before[:3, :3]) @ tip + after[:3, 3] - before[:3, 3]
    return before[:3, :3].T @ moved / 1e-6


def _judge(
    mesh: object, plane: np.ndarray, center: np.ndarray, radius: float, axis: np.ndarray, outer: np.ndarray, topic: str,
    guesses: Guesses,
) -> None:  # fmt: skip
    """Note how far the link's outline, where it touches, is from the circle: -30 to 90 deg from its end."""
    assert isinstance(mesh, trimesh.Trimesh)
    u = _unit(outer - center)
    pad = -np.cross(axis, u)
    lines = trimesh.intersections.mesh_plane(mesh, axis, plane + 1e-7 * axis)
    points = lines.reshape(-1, 3) - center if len(lines) else np.asarray(mesh.vertices) - center
    with contextlib.suppress(QhullError):  # a link of several solids has edges within that touch nothing
        points = points[ConvexHull(np.stack([points @ pad, points @ u], axis=1)).vertices]
    toward = np.degrees(np.arctan2(points @ pad, -(points @ u)))
    touching = points[(toward > -30) & (toward < 90)]
    size = np.linalg.norm(touching - np.outer(touching @ axis, axis), axis=1) if len(touching) else np.array([radius])
    worst = float(np.abs(size - radius).max())
    found = (
        f"circle of radius {radius * 1e3:.1f} mm; the outline is up to {worst * 1e3:.1f} mm from it where it touches"
    )
    if worst > max(0.3 * radius, 0.002):
        guesses.add(topic, f"{found}: not a round tip", "UNSURE" if worst > 0.006 else "likely")
    else:
        guesses.add(topic, found, "sure" if worst < 0.1 * radius else "likely")


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
