"""Exact distance between the hull of a few points and a triangle: Gilbert, Johnson & Keerthi (1988)."""

import numpy as np
from numba import njit

from dexgrasp.triangle_tree import to_triangle

STEPS = 64
"""Steps of one query; 3 to 8 are usual."""
PRECISION = 1e-6
"""Distances may be told too small by this part."""
TOUCHING = 1e-8
"""Distances below this are taken as none, m."""


@njit(cache=True, error_model="numpy", fastmath={"nnan", "nsz"})
def farthest(
    points: np.ndarray, count: int, a: float, b: float, c: float, u: float, v: float, w: float
) -> tuple[float, float]:
    """Return how far the first `count` of points (3, K) reach along each of two directions."""
    one, two = -np.inf, -np.inf
    for k in range(count):
        x, y, z = points[0, k], points[1, k], points[2, k]
        first, second = a * x + b * y + c * z, u * x + v * y + w * z
        one = first if first > one else one
        two = second if second > two else two
    return one, two


@njit(cache=True, error_model="numpy")
def to_hull(
    points: np.ndarray,
    count: int,
    corners: np.ndarray,
    triangle: int,
    direction: np.ndarray,
    close: float,
    work: np.ndarray,
) -> float:
    """Return the distance of a triangle of corners (T, 3, 3) to the hull of the first `count` of points (3, K), m.

    `direction` (3,), from the hull to the triangle, is the first guess, and afterwards the unit direction of the
    shortest way. Of a distance above `close` some lower bound above it, and at least half as large, is told.
    `work` (5, 4, 3) is scratch; afterwards work[4, 0] holds the weights of the triangle's corners in its nearest point.
    """
    simplex, told = work[3], work[4]
    x, y, z = direction[0], direction[1], direction[2]
    size, found, bound = 0, np.inf, 0.0
    for _ in range(STEPS):
        corner, reach = 0, -np.inf
        for k in range(count):
            value = points[0, k] * x + points[1, k] * y + points[2, k] * z
            if value > reach:
                corner, reach = k, value
        t, value = 0, np.inf
        for k in range(3):
            other = corners[triangle, k, 0] * x + corners[triangle, k, 1] * y + corners[triangle, k, 2] * z
            if other < value:
                t, value = k, other
        length = np.sqrt(x * x + y * y + z * z)
        bound = (value - reach) / length
        if size and (length - bound <= PRECISION * length or (bound >= close and 2 * bound >= length)):
            break
        for i in range(3):
            simplex[size, i] = corners[triangle, t, i] - points[i, corner]
        told[size, 1] = t
        size = _reduce(work, size + 1)
        if size == 4:
            return 0.0
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
            return 0.0
    direction[0], direction[1], direction[2] = x / found, y / found, z / found
    return max(bound, 0.0)


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
