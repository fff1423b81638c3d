"""The fingertip circle: a fit to the outline of a link in its joint's mid-plane (METHOD section 1)."""

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from dexgrasp.errors import DexgraspError

RESIDUAL = 0.004
"""Largest distance of an outline vertex from the circle, relative to its radius."""
ASIDE = 0.002
"""A tip whose middle lies farther than this off the joint's plane is cut through its own middle, m."""
END = 0.2
"""The tip's middle is that of this part of the link's length."""
LARGEST_STEP = np.radians(40.0)
"""Neighbouring outline vertices farther apart than this on the circle are a flat, not an arc."""
SHORTEST_ARC = np.radians(40.0)


def fit_fingertip(
    mesh: trimesh.Trimesh, origin: Float[ndarray, "3"], axis: Float[ndarray, "3"], distal: Float[ndarray, "3"] | None
) -> tuple[Float[ndarray, "3"], float]:
    """Return centre (m) and radius (m) of the circle that ends a finger's side view.

    The outline is the convex hull of the mesh's section by the plane through `origin` with normal `axis`, or, where the
    tip lies aside of that by more than `ASIDE`, by the parallel plane through the tip's middle. Of all its
    stretches beyond the middle of the finger that are circle arcs, the longest wins. A tip without an arc (a box)
    gets the largest circle that fits its end. `distal` points from the joint to the tip; None finds it.
    """
    first, second = _plane_axes(axis)
    aside = _aside(mesh, origin, axis, distal)
    origin = origin + (aside if abs(aside) > ASIDE else 0.0) * axis
    outline = _outline(mesh, origin, axis, first, second)
    if distal is None:
        towards = outline[np.argmax(np.linalg.norm(outline, axis=1))]
    else:
        towards = np.array([distal @ first, distal @ second])
    towards = towards / np.linalg.norm(towards)
    along = outline @ towards
    end = outline[_rotated(along >= (along.min() + along.max()) / 2)]
    circle = _longest_arc(end, np.ptp(end @ np.array([-towards[1], towards[0]])))
    center, radius = circle if circle is not None else _inscribed(end, towards)
    return origin + center[0] * first + center[1] * second, radius


def _aside(mesh: trimesh.Trimesh, origin: ndarray, axis: ndarray, distal: ndarray | None) -> float:
    """Return how far along `axis` the middle of the link's end lies."""
    corners = mesh.vertices - origin
    across = corners @ axis
    flat = corners - across[:, None] * axis
    towards = flat[np.argmax(np.linalg.norm(flat, axis=1))] if distal is None else distal
    along = flat @ towards / np.linalg.norm(towards)
    end = across[along >= along.max() - END * np.ptp(along)]
    return float((end.min() + end.max()) / 2)


def _plane_axes(axis: ndarray) -> tuple[ndarray, ndarray]:
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _outline(mesh: trimesh.Trimesh, origin: ndarray, axis: ndarray, first: ndarray, second: ndarray) -> ndarray:
    """Return the hull of the section, (K, 2), counter-clockwise, about the joint."""
    # An offset far below any tolerance keeps the plane off mesh edges that lie in it.
    lines = trimesh.intersections.mesh_plane(mesh, axis, origin + 1e-7 * axis)
    if len(lines) == 0:
        lines = mesh.vertices[None]
    points = lines.reshape(-1, 3) - origin
    flat = np.stack([points @ first, points @ second], axis=1)
    try:
        return flat[ConvexHull(flat).vertices]
    except QhullError as error:
        raise DexgraspError(
            "a fingertip with a solid section in its joint's mid-plane",
            f"a degenerate outline of {len(flat)} points",
            "give tip_radius and tip_center of the finger in the hand's YAML",
        ) from error


def _rotated(mask: ndarray) -> ndarray:
    """Return the indices of a cyclic run of True, in order, starting where the run starts."""
    starts = np.flatnonzero(mask & ~np.roll(mask, 1))
    order = np.arange(len(mask)) if len(starts) == 0 else (np.arange(len(mask)) + starts[0]) % len(mask)
    return order[mask[order]]


def _longest_arc(points: ndarray, width: float) -> tuple[ndarray, float] | None:
    best, longest = None, 0.0
    for start in range(len(points)):
        for stop in range(len(points), start + 4, -1):
            window = points[start:stop]
            center, radius = _circle(window)
            if not 0 < radius <= 0.75 * width:
                continue
            spokes = window - center
            if np.abs(np.linalg.norm(spokes, axis=1) - radius).max() > RESIDUAL * radius:
                continue
            turns = np.diff(np.unwrap(np.arctan2(spokes[:, 1], spokes[:, 0])))
            arc = turns.sum()
            if turns.min() > 0 and turns.max() <= LARGEST_STEP and arc >= SHORTEST_ARC and arc * radius > longest:
                best, longest = (center, radius), arc * radius
            break  # shorter windows of this start are shorter arcs
    return best


def _circle(points: ndarray) -> tuple[ndarray, float]:
    """Return the least-squares circle through points (K, 2) (Kasa's linear fit)."""
    matrix = np.column_stack([2 * points, np.ones(len(points))])
    solution = np.linalg.lstsq(matrix, (points**2).sum(axis=1), rcond=None)[0]
    square = solution[2] + solution[:2] @ solution[:2]
    return solution[:2], float(np.sqrt(square)) if square > 0 else 0.0


def _inscribed(points: ndarray, towards: ndarray) -> tuple[ndarray, float]:
    side = np.array([-towards[1], towards[0]])
    across = points @ side
    radius = float(np.ptp(across) / 2)
    return (across.min() + radius) * side + ((points @ towards).max() - radius) * towards, radius
