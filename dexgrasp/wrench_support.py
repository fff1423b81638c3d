"""Support points of wrench hulls, and a simplex inside them to grow a polytope from.

Wrenches lie column by column, (6, W), so that compilers work on several at once. `contacts` = 0 stands for the L1
hull, that of all wrenches; otherwise they belong, in equal parts and in order, to so many contacts, and the hull is
L-infinity: the Minkowski sum over contacts of conv(0, their wrenches).
"""

import numpy as np
from numba import njit

DIM = 6
Vector = tuple[float, float, float, float, float, float]
"""Of six numbers, in registers."""
ZERO = 1e-10
"""An epsilon, or a thickness of the whole set, below this is zero (wrenches of order 1)."""


@njit(cache=True)
def row(array: np.ndarray, i: int) -> Vector:
    """Read one row of an array (N, 6) into registers."""
    return array[i, 0], array[i, 1], array[i, 2], array[i, 3], array[i, 4], array[i, 5]


@njit(cache=True)
def plane(planes: np.ndarray, f: int) -> Vector:
    """Read the normal of facet f; see wrench_hull."""
    at = 8 * f
    return planes[at], planes[at + 1], planes[at + 2], planes[at + 3], planes[at + 4], planes[at + 5]


@njit(cache=True)
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@njit(cache=True)
def support(
    wrenches: np.ndarray, contacts: int, u: Vector, values: np.ndarray, corners: np.ndarray, apex: int
) -> tuple[float, int]:
    """Write the hull's farthest point along u as row `apex` of corners; return h(u) and, for L1, its wrench."""
    count = wrenches.shape[1]
    for i in range(count):
        values[i] = (
            wrenches[0, i] * u[0]
            + wrenches[1, i] * u[1]
            + wrenches[2, i] * u[2]
            + wrenches[3, i] * u[3]
            + wrenches[4, i] * u[4]
            + wrenches[5, i] * u[5]
        )
    best = 0
    if contacts == 0:
        for i in range(count):
            if values[i] > values[best]:
                best = i
        for k in range(DIM):
            corners[apex, k] = wrenches[k, best]
        return values[best], best
    for k in range(DIM):
        corners[apex, k] = 0.0
    reach = 0.0
    size = count // contacts
    for contact in range(contacts):
        best = contact * size
        for i in range(best, best + size):
            if values[i] > values[best]:
                best = i
        if values[best] > 0.0:  # a contact that would only harm does not press
            reach += values[best]
            for k in range(DIM):
                corners[apex, k] += wrenches[k, best]
    return reach, 0


@njit(cache=True)
def simplex(
    wrenches: np.ndarray,
    contacts: int,
    rest: np.ndarray,
    values: np.ndarray,
    corners: np.ndarray,
    axes: np.ndarray,
    names: np.ndarray,
) -> bool:
    """Write 7 affinely independent points of the hull, each far from the flat of those before it; False: none.

    axes (6, 6) become an orthonormal frame whose first k axes span the flat of corners 0 to k. rest (6, W) and
    values (W,) are scratch; names say which wrench a corner is (L1).
    """
    count = wrenches.shape[1]
    rest[:] = wrenches
    for step in range(DIM + 1):
        best = 0
        for i in range(count):
            values[i] = (
                rest[0, i] ** 2
                + rest[1, i] ** 2
                + rest[2, i] ** 2
                + rest[3, i] ** 2
                + rest[4, i] ** 2
                + rest[5, i] ** 2
            )
        for i in range(count):
            if values[i] > values[best]:
                best = i
        size = np.sqrt(values[best])
        if size < ZERO:
            return False
        names[step] = best
        if contacts:
            u = (rest[0, best], rest[1, best], rest[2, best], rest[3, best], rest[4, best], rest[5, best])
            _farther(wrenches, contacts, u, values, corners, step)
            if step == 0:
                continue
            _orthogonalise(corners, axes, step)
        else:
            for k in range(DIM):
                corners[step, k] = wrenches[k, best]
            if step == 0:
                for k in range(DIM):
                    for i in range(count):
                        rest[k, i] -= corners[0, k]
                continue
            for k in range(DIM):
                axes[step - 1, k] = rest[k, best] / size
        u = row(axes, step - 1)
        for i in range(count):
            along = (
                rest[0, i] * u[0]
                + rest[1, i] * u[1]
                + rest[2, i] * u[2]
                + rest[3, i] * u[3]
                + rest[4, i] * u[4]
                + rest[5, i] * u[5]
            )
            rest[0, i] -= along * u[0]
            rest[1, i] -= along * u[1]
            rest[2, i] -= along * u[2]
            rest[3, i] -= along * u[3]
            rest[4, i] -= along * u[4]
            rest[5, i] -= along * u[5]
    return True


@njit(cache=True)
def _farther(
    wrenches: np.ndarray, contacts: int, u: Vector, values: np.ndarray, corners: np.ndarray, step: int
) -> None:
    """Write as corner `step` the hull's farthest point from corner 0 along u, to either side."""
    support(wrenches, contacts, u, values, corners, step)
    if step:
        ahead, start = row(corners, step), dot(u, row(corners, 0))
        back = (-u[0], -u[1], -u[2], -u[3], -u[4], -u[5])
        support(wrenches, contacts, back, values, corners, step)
        if abs(dot(u, row(corners, step)) - start) < abs(dot(u, ahead) - start):
            for k in range(DIM):
                corners[step, k] = ahead[k]


@njit(cache=True)
def _orthogonalise(corners: np.ndarray, axes: np.ndarray, step: int) -> None:
    """Write as axis step - 1 the direction in which corner `step` leaves the flat of those before it."""
    for k in range(DIM):
        axes[step - 1, k] = corners[step, k] - corners[0, k]
    for _ in range(2):  # once more against rounding
        for j in range(step - 1):
            along = dot(row(axes, step - 1), row(axes, j))
            for k in range(DIM):
                axes[step - 1, k] -= along * axes[j, k]
    size = np.sqrt(dot(row(axes, step - 1), row(axes, step - 1)))
    for k in range(DIM):
        axes[step - 1, k] /= size


@njit(cache=True)
def simplex_normals(corners: np.ndarray, axes: np.ndarray, normals: np.ndarray) -> None:
    """Write the outward unit normals (7, 6) of the facets opposite each corner of `simplex`."""
    lower = np.empty((DIM, DIM))  # edges from corner 0 = lower @ axes
    for k in range(DIM):
        for j in range(k + 1):
            lower[k, j] = 0.0
            for m in range(DIM):
                lower[k, j] += (corners[k + 1, m] - corners[0, m]) * axes[j, m]
    inverse = np.empty(DIM)
    for m in range(DIM):
        normals[0, m] = 0.0
    for k in range(DIM):  # column k of the edges' inverse is the gradient of corner k + 1's barycentric coordinate
        for m in range(k, DIM):
            inverse[m] = 1.0 if m == k else 0.0
            for j in range(k, m):
                inverse[m] -= lower[m, j] * inverse[j]
            inverse[m] /= lower[m, m]
        for m in range(DIM):
            gradient = 0.0
            for j in range(k, DIM):
                gradient += inverse[j] * axes[j, m]
            normals[k + 1, m] = -gradient
            normals[0, m] += gradient
    for f in range(DIM + 1):
        scale = 1.0 / np.sqrt(dot(row(normals, f), row(normals, f)))
        for m in range(DIM):
            normals[f, m] *= scale


@njit(cache=True)
def determinant(matrix: np.ndarray) -> float:
    """Return the determinant of a (6, 6) matrix, which is overwritten."""
    result = 1.0
    for c in range(DIM):
        p = c
        for r in range(c + 1, DIM):
            if abs(matrix[r, c]) > abs(matrix[p, c]):
                p = r
        if matrix[p, c] == 0.0:
            return 0.0
        if p != c:
            result = -result
        result *= matrix[p, c]
        for k in range(c, DIM):
            matrix[c, k], matrix[p, k] = matrix[p, k], matrix[c, k]
        for r in range(c + 1, DIM):
            factor = matrix[r, c] / matrix[c, c]
            for k in range(c, DIM):
                matrix[r, k] -= factor * matrix[c, k]
    return result


@njit(cache=True)
def random_words(count: int) -> np.ndarray:
    """Return random 64-bit words (SplitMix64), one for each corner of a polytope."""
    words, state = np.empty(count, np.uint64), np.uint64(0)
    for i in range(count):
        state += np.uint64(0x9E3779B97F4A7C15)
        word = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        words[i] = word ^ (word >> np.uint64(31))
    return words
