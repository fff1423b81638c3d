"""A link's surface as balls: each touches it from inside, and bounding balls above them make a tree.

Balls inscribed at surface points follow a rounded finger far more closely than they are apart: between two balls of
radius r at distance s the surface is missed by s^2 / 8 r only.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from dexgrasp.link_shape import once_per_shape

PROTRUSION = 3e-5
"""How far a ball may stand out of its part, m: what lets balls bridge the facets of a round surface."""


def planes(part: trimesh.Trimesh) -> np.ndarray:
    """Return the half-spaces (K, 4) of a convex part: normal . x <= offset inside, m."""
    normals = part.face_normals
    offsets = np.einsum("ij,ij->i", normals, part.triangles[:, 0])
    keys = np.round(np.column_stack([normals, offsets * 1e2]), 7)
    _, first = np.unique(keys, axis=0, return_index=True)
    return np.column_stack([normals, offsets])[np.sort(first)]


def inscribed(points: np.ndarray, normals: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return radii (N,) of the balls in a convex part that touch its surface from inside at points (N, 3), m."""
    slack = np.maximum(sides[:, 3] - points @ sides[:, :3].T, 0) + PROTRUSION
    slope = 1 - normals @ sides[:, :3].T
    return np.where(slope > 1e-9, slack / np.maximum(slope, 1e-9), np.inf).min(axis=1)


@once_per_shape
def inscribed_tree(parts: Sequence[trimesh.Trimesh], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return `ball_tree` of `inscribed_balls`, (M, 4) and (M, 2)."""
    return ball_tree(inscribed_balls(parts, tolerance))


def inscribed_balls(parts: Sequence[trimesh.Trimesh], tolerance: float) -> np.ndarray:
    """Return balls (B, 4) of centre and radius (m) that fill the union of convex parts from inside its surface.

    Every point of a lattice on the surface, 20 tolerances wide, lies within `tolerance` (m) of some ball.
    """
    bodies = [planes(part) for part in parts]
    found, surface = [], []
    for number, part in enumerate(parts):
        points, normals = _lattice(part, min(20 * tolerance, 1.5e-3))
        buried = np.zeros(len(points), dtype=bool)
        for other, body in enumerate(bodies):
            if other != number:
                buried |= (points @ body[:, :3].T - body[:, 3]).max(axis=1) < -1e-6
        points, normals = points[~buried], normals[~buried]
        radius = inscribed(points, normals, bodies[number])
        found.append(np.column_stack([points - radius[:, None] * normals, radius]))
        surface.append(points)
    balls, touched = np.concatenate(found), np.concatenate(surface)
    # Large balls first, each kept only if it reaches a point of the surface that is still bare.
    order = np.lexsort((*balls[:, :3].T, -np.round(balls[:, 3], 6)))
    near = cKDTree(touched)
    bare = np.ones(len(touched), dtype=bool)
    kept = []
    for place in order:
        if not bare[place]:
            continue
        bare[near.query_ball_point(balls[place, :3], balls[place, 3] + tolerance)] = False
        kept.append(place)
    return balls[kept]


def _lattice(part: trimesh.Trimesh, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the faces of a mesh, rows at most `spacing` apart, and their face normals."""
    triangles = np.asarray(part.triangles)
    start = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).argmin(axis=1)
    turned = (start[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(triangles, turned[..., None], axis=1).swapaxes(0, 1)  # the shortest edge is a-b
    longest = np.maximum(np.linalg.norm(c - a, axis=1), np.linalg.norm(c - b, axis=1))
    rows = np.ceil(longest / spacing).astype(int)
    face, row = _counted(rows)
    left, right = (end[face] + (c - end)[face] * row[:, None] / np.maximum(rows, 1)[face, None] for end in (a, b))
    steps = np.ceil(np.linalg.norm(right - left, axis=1) / spacing).astype(int)
    line, step = _counted(steps)
    share = np.where(step < steps[line], step * (1 / np.maximum(steps, 1)[line]), 1.0)  # ends exactly
    points = left[line] + (right - left)[line] * share[:, None]
    return points, np.asarray(part.face_normals)[face[line]]


def _counted(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return who counts, and the count, while each of `ends` (N,) in turn counts from 0 to itself."""
    who = np.repeat(np.arange(len(ends)), ends + 1)
    return who, np.arange(len(who)) - np.repeat(np.cumsum(ends + 1) - ends - 1, ends + 1)


def ball_tree(leaves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return balls (M, 4) and children (M, 2; -1 for a leaf) of a binary tree over leaves (B, 4), root 0."""
    balls, children = np.empty((2 * len(leaves) - 1, 4)), np.full((2 * len(leaves) - 1, 2), -1)
    stack = [(np.arange(len(leaves)), -1, 0)]
    count = 0
    while stack:
        members, parent, side = stack.pop()
        node, count = count, count + 1
        if parent >= 0:
            children[parent, side] = node
        if len(members) == 1:
            balls[node] = leaves[members[0]]
            continue
        inside = leaves[members]
        low = (inside[:, :3] - inside[:, 3:]).min(axis=0)
        high = (inside[:, :3] + inside[:, 3:]).max(axis=0)
        center = (low + high) / 2
        balls[node, :3] = center
        balls[node, 3] = (np.linalg.norm(inside[:, :3] - center, axis=1) + inside[:, 3]).max()
        spread = np.ptp(inside[:, :3], axis=0)
        order = np.argsort(inside[:, int(spread.argmax())], kind="stable")
        half = len(members) // 2
        stack.append((members[order[half:]], node, 1))
        stack.append((members[order[:half]], node, 0))
    return balls, children
