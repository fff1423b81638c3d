"""Exact distance between a convex polytope and a triangle: Gilbert, Johnson & Keerthi (1988)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from numba import njit

from dexgrasp.triangle_tree import to_triangle

STEPS = 64
"""Steps of one query; 3 to 8 are usual."""
PRECISION = 1e-6
"""Distances may be told too small by this part."""
TOUCHING = 1e-8
"""Distances below this are taken as none, m."""


class Polytopes(NamedTuple):
    """P convex bodies of V corners in all, m."""

    corners: np.ndarray
    """(V, 3)."""
    firsts: np.ndarray
    """(P + 1,) the first corner of each."""
    starts: np.ndarray
    """(V + 1,) the first of each corner's neighbours"""
    neighbours: np.ndarray
    """(E,) in this list: corners that share an edge."""


def polytopes(bodies: Sequence[trimesh.Trimesh]) -> Polytopes:
    """Return convex meshes (m) as arrays."""
    corners, firsts, ends = [], [0], []
    for body in bodies:
        hull = body.convex_hull
        ends.append(np.concatenate([hull.edges_unique, hull.edges_unique[:, ::-1]]) + firsts[-1])
        corners.append(np.asarray(hull.vertices))
        firsts.append(firsts[-1] + len(hull.vertices))
    pairs = np.concatenate(ends)
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    starts = np.searchsorted(pairs[:, 0], np.arange(firsts[-1] + 1))
    return Polytopes(np.concatenate(corners), np.array(firsts), starts, np.ascontiguousarray(pairs[:, 1]))


@njit(cache=True, error_model="numpy")
def support(bodies: Polytopes, corner: int, x: float, y: float, z: float) -> int:
    """Return the corner of a body that lies farthest in a direction, by climbing from one of its corners."""
    corners, starts, neighbours = bodies.corners, bodies.starts, bodies.neighbours
    best = corners[corner, 0] * x + corners[corner, 1] * y + corners[corner, 2] * z
    climbing = True
    while climbing:
        climbing = False
        here = corner
        for e in range(starts[here], starts[here + 1]):
            other = neighbours[e]
            value = corners[other, 0] * x + corners[other, 1] * y + corners[other, 2] * z
            if value > best:
                best, corner, climbing = value, other, True
    return corner


@njit(cache=True, error_model="numpy")
def to_polytope(
    bodies: Polytopes,
    corner: int,
    triangle: np.ndarray,
    direction: np.ndarray,
    close: float,
    limit: float,
    work: np.ndarray,
) -> tuple[float, int]:
    """Return the distance of a triangle (3, 3) to the body that has `corner`, and a corner near to it; m.

    `direction` (3,), from the body to the triangle, is the first guess, and afterwards the unit direction of the
    shortest way. Of a distance above `close` some lower bound above it, and at least half as large, is told, and above
    `limit` any bound above it. `work` (5, 4, 3) is scratch;
    afterwards work[4, 0] holds the weights of the triangle's corners in its nearest point.
    """
    corners, simplex, told = bodies.corners, work[3], work[4]
    x, y, z = direction[0], direction[1], direction[2]
    size, found, bound = 0, np.inf, 0.0
    for _ in range(STEPS):
        corner = support(bodies, corner, x, y, z)
        t, value = 0, np.inf
        for k in range(3):
            other = triangle[k, 0] * x + triangle[k, 1] * y + triangle[k, 2] * z
            if other < value:
                t, value = k, other
        length = np.sqrt(x * x + y * y + z * z)
        bound = (value - corners[corner, 0] * x - corners[corner, 1] * y - corners[corner, 2] * z) / length
        if bound > limit:
            direction[0], direction[1], direction[2] = x / length, y / length, z / length
            return bound, corner
        if size and (length - bound <= PRECISION * length or (bound >= close and 2 * bound >= length)):
            break
        for i in range(3):
            simplex[size, i] = triangle[t, i] - corners[corner, i]
        told[size, 1] = t
        size = _reduce(work, size + 1)
        if size == 4:
            return 0.0, corner
        a, b, c = 0.0, 0.0, 0.0
        for k in range(size):
            a += told[k, 2] * simplex[k, 0]
            b += told[k, 2] * simplex[k, 1]
            c += told[k, 2] * simplex[k, 2]
        square = a * a + b * b + c * c
        if square >= found * found:  # no nearer: the last one was the nearest, to rounding
            break
        x, y, z, found = a, b, c, np.sqrt(square)
        told[0, 0] = told[1, 0] = told[2, 0] = 0.0
        for k in range(size):
            told[int(told[k, 1]), 0] += told[k, 2]
        if found <= TOUCHING:
            return 0.0, corner
    direction[0], direction[1], direction[2] = x / found, y / found, z / found
    return max(bound, 0.0), corner


@njit(cache=True, error_model="numpy")
def _reduce(work: np.ndarray, size: int) -> int:
    """Keep those corners of a simplex that its point nearest to the origin lies among; return how many, 4 for inside.

    Of four, the last is new: the nearest point lies on a face that has it (the origin is not beyond the old one).
    """
    simplex, told = work[3], work[4]
    if size == 1:
        told[0, 2] = 1.0
        return 1
    if size == 2:
        along, square = 0.0, 0.0
        for i in range(3):
            edge = simplex[1, i] - simplex[0, i]
            along -= simplex[0, i] * edge
            square += edge * edge
        part = min(max(along / max(square, 1e-300), 0.0), 1.0)
        if part == 1.0:
            simplex[0], told[0, 1] = simplex[1], told[1, 1]
        told[0, 2], told[1, 2] = 1.0 - part if part < 1.0 else 1.0, part
        return 2 if 0.0 < part < 1.0 else 1
    least, best, at1, at2, feature = np.inf, -1, 0.0, 0.0, 0
    for face in range(1 if size == 3 else 3):
        a, b, c = (0, 1, 2) if size == 3 else (face // 2, 1 + (face + 1) // 2, 3)
        if size == 4 and not _beyond(simplex, a, b, c, 3 - a - b):
            continue
        work[face, 0], work[face, 1], work[face, 2] = simplex[a], simplex[b], simplex[c]
        square, v, w, kind = to_triangle(work, face, 0.0, 0.0, 0.0)
        if square < least:
            least, best, at1, at2, feature = square, face, v, w, kind
    if best < 0:
        return 4
    count = 0
    for k in range(3):
        if (
            feature == 0
            or (k == 0 and feature in (1, 3, 4))
            or (k == 1 and feature in (1, 2, 5))
            or (k == 2 and feature in (2, 3, 6))
        ):
            a = k if size == 3 else (best // 2, 1 + (best + 1) // 2, 3)[k]
            told[count, 1], told[count, 2] = told[a, 1], (1.0 - at1 - at2, at1, at2)[k]
            simplex[count] = work[best, k]
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def _beyond(simplex: np.ndarray, a: int, b: int, c: int, d: int) -> bool:
    """Whether the origin is not on the same side of the plane a, b, c as corner d."""
    ux, uy, uz = simplex[b, 0] - simplex[a, 0], simplex[b, 1] - simplex[a, 1], simplex[b, 2] - simplex[a, 2]
    vx, vy, vz = simplex[c, 0] - simplex[a, 0], simplex[c, 1] - simplex[a, 1], simplex[c, 2] - simplex[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    origin = -(nx * simplex[a, 0] + ny * simplex[a, 1] + nz * simplex[a, 2])
    dx, dy, dz = simplex[d, 0] - simplex[a, 0], simplex[d, 1] - simplex[a, 1], simplex[d, 2] - simplex[a, 2]
    height = nx * dx + ny * dy + nz * dz
    flat = height * height <= 1e-20 * (nx * nx + ny * ny + nz * nz) * (dx * dx + dy * dy + dz * dz)
    return flat or origin * height < 0
