"""Lazy 6-D quickhull: distance from the origin to the boundary of the convex hull of wrenches, certified.

h(u) = max_i w_i . u over any unit u bounds epsilon from above; the smallest signed facet distance of any polytope
spanned by some of the wrenches bounds it from below. The polytope grows only at the facet nearest the origin until
both bounds meet, so most facets of the whole hull are never built.
"""

import numpy as np
from numba import njit

from dexgrasp.heap import pop, push

DIM = 6
ROUNDING = 1e-13
"""Distances below this (wrenches of order 1) count as on the plane when facets are sorted into visible and hidden."""
EXACT = 1e-12
"""The two bounds have met."""
ZERO = 1e-10
"""An epsilon, or a thickness of the whole set, below this is zero."""


@njit(cache=True)
def epsilons(wrenches: np.ndarray, threshold: float, decide: bool) -> np.ndarray:
    """Return epsilon of N wrench sets (N, W, 6).

    A set certified to lie below `threshold` gives 0; with `decide`, one certified to reach it gives a lower bound that
    is at least `threshold` instead of the exact value.
    """
    result = np.zeros(len(wrenches))
    for i in range(len(wrenches)):
        result[i] = _epsilon(wrenches[i], threshold, decide)
    return result


@njit(cache=True)
def _simplex(points: np.ndarray) -> tuple[bool, np.ndarray]:
    """Pick 7 affinely independent points, each the farthest from the flat of those before it."""
    count = len(points)
    chosen = np.zeros(DIM + 1, np.int64)
    rest = points.copy()
    best = -1.0
    for i in range(count):
        size = 0.0
        for k in range(DIM):
            size += points[i, k] ** 2
        if size > best:
            best, chosen[0] = size, i
    first = points[chosen[0]]
    for i in range(count):
        for k in range(DIM):
            rest[i, k] -= first[k]
    for step in range(1, DIM + 1):
        best = -1.0
        for i in range(count):
            size = 0.0
            for k in range(DIM):
                size += rest[i, k] ** 2
            if size > best:
                best, chosen[step] = size, i
        if best < ZERO**2:
            return False, chosen
        axis = rest[chosen[step]] / np.sqrt(best)
        for i in range(count):
            along = 0.0
            for k in range(DIM):
                along += rest[i, k] * axis[k]
            for k in range(DIM):
                rest[i, k] -= along * axis[k]
    return True, chosen


@njit(cache=True)
def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Invert a regular 6x6 matrix (Gauss-Jordan, row pivots)."""
    a = matrix.copy()
    inverse = np.eye(DIM)
    for c in range(DIM):
        p = c
        for r in range(c + 1, DIM):
            if abs(a[r, c]) > abs(a[p, c]):
                p = r
        for k in range(DIM):
            a[c, k], a[p, k] = a[p, k], a[c, k]
            inverse[c, k], inverse[p, k] = inverse[p, k], inverse[c, k]
        scale = 1.0 / a[c, c]
        for k in range(DIM):
            a[c, k] *= scale
            inverse[c, k] *= scale
        for r in range(DIM):
            factor = a[r, c]
            if r != c and factor != 0.0:
                for k in range(DIM):
                    a[r, k] -= factor * a[c, k]
                    inverse[r, k] -= factor * inverse[c, k]
    return inverse


@njit(cache=True)
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@njit(cache=True)
def _grown(array: np.ndarray, rows: int) -> np.ndarray:
    larger = np.empty((rows, array.shape[1]), array.dtype)
    larger[: len(array)] = array
    return larger


@njit(cache=True)
def _epsilon(points: np.ndarray, threshold: float, decide: bool) -> float:
    full, chosen = _simplex(points)
    if not full:
        return 0.0
    capacity = 512
    planes = np.empty((capacity, DIM + 1))  # unit outward normal, offset = signed distance of the origin
    vertices = np.empty((capacity, DIM), np.int64)
    neighbours = np.empty((capacity, DIM), np.int64)  # across the ridge opposite each vertex
    births = np.empty((capacity, DIM), np.int64)  # the new facet on that ridge, while a point is added
    marks = np.zeros((capacity, 1), np.int64)  # number of the point that sees the facet; -1: gone
    keys, ids = np.empty(capacity), np.empty(capacity, np.int64)
    count, heap = DIM + 1, 0

    edges = np.empty((DIM, DIM))
    for k in range(DIM):
        edges[k] = points[chosen[k + 1]] - points[chosen[0]]
    # Column k of the inverse is the gradient of the barycentric coordinate of vertex k + 1.
    gradients = _inverse(edges)
    for f in range(DIM + 1):
        size = 0.0
        for k in range(DIM):
            if f == 0:
                value = 0.0
                for j in range(DIM):
                    value += gradients[k, j]
            else:
                value = -gradients[k, f - 1]
            planes[f, k] = value
            size += value * value
        size = np.sqrt(size)
        for k in range(DIM):
            planes[f, k] /= size
        slot = 0
        for v in range(DIM + 1):
            if v != f:
                vertices[f, slot], neighbours[f, slot] = chosen[v], v
                slot += 1
        planes[f, DIM] = _dot(planes[f], points[vertices[f, 0]])
        heap = push(keys, ids, heap, planes[f, DIM], f)

    upper = np.inf
    visible = np.empty(capacity, np.int64)
    for turn in range(1, 100_000):
        facet = ids[0]
        heap = pop(keys, ids, heap)
        while marks[facet, 0] < 0:
            facet = ids[0]
            heap = pop(keys, ids, heap)
        lower = planes[facet, DIM]
        if decide and lower >= threshold:
            return lower
        apex, reach = 0, -np.inf
        for i in range(len(points)):
            value = _dot(planes[facet], points[i])
            if value > reach:
                apex, reach = i, value
        upper = min(upper, reach)
        if upper <= ZERO or upper < threshold:
            return 0.0
        if reach - lower <= EXACT:
            return lower if lower > ZERO else 0.0

        # Facets that the apex sees, by walking from the one it was found on.
        seen = 1
        visible[0] = facet
        marks[facet, 0] = turn
        ridges = 0
        head = 0
        while head < seen:
            f = visible[head]
            head += 1
            for k in range(DIM):
                g = neighbours[f, k]
                if marks[g, 0] == turn:
                    continue
                if _dot(planes[g], points[apex]) - planes[g, DIM] > ROUNDING:
                    marks[g, 0] = turn
                    if seen == len(visible):
                        visible = np.concatenate((visible, visible))
                    visible[seen] = g
                    seen += 1
                else:
                    ridges += 1
        if count + ridges * DIM > capacity:  # generous: ridges may have been counted before a neighbour was seen
            capacity = 2 * (count + ridges * DIM)
            planes, vertices = _grown(planes, capacity), _grown(vertices, capacity)
            neighbours, births = _grown(neighbours, capacity), _grown(births, capacity)
            old = len(marks)
            marks = _grown(marks, capacity)
            marks[old:] = 0
            wider = np.empty(capacity)
            wider[:heap] = keys[:heap]
            keys = wider
            wider_ids = np.empty(capacity, np.int64)
            wider_ids[:heap] = ids[:heap]
            ids = wider_ids

        start = count
        for s in range(seen):
            f = visible[s]
            above = _dot(planes[f], points[apex]) - planes[f, DIM]
            for k in range(DIM):
                g = neighbours[f, k]
                if marks[g, 0] == turn:
                    continue
                # The plane through ridge and apex, from the pencil of the two planes that meet at the ridge.
                below = min(_dot(planes[g], points[apex]) - planes[g, DIM], 0.0)
                size = 0.0
                for j in range(DIM):
                    planes[count, j] = above * planes[g, j] - below * planes[f, j]
                    size += planes[count, j] ** 2
                size = np.sqrt(size)
                for j in range(DIM):
                    planes[count, j] /= size
                    vertices[count, j] = vertices[f, j]
                vertices[count, k] = apex
                planes[count, DIM] = _dot(planes[count], points[apex])
                neighbours[count, k] = g
                births[f, k] = count
                for j in range(DIM):
                    if neighbours[g, j] == f:
                        neighbours[g, j] = count
                heap = push(keys, ids, heap, planes[count, DIM], count)
                count += 1
        # New facets meet where a turn about their common face, through visible facets only, leads from ridge to ridge.
        for s in range(seen):
            first = visible[s]
            for k in range(DIM):
                if marks[neighbours[first, k], 0] == turn:
                    continue
                new = births[first, k]
                for j in range(DIM):
                    if j == k:
                        continue
                    f, leave, keep = first, j, vertices[first, k]
                    while marks[neighbours[f, leave], 0] == turn:
                        g = neighbours[f, leave]
                        entered = -1
                        into = -1
                        for m in range(DIM):
                            known = False
                            for q in range(DIM):
                                if vertices[g, m] == vertices[f, q]:
                                    known = True
                            if not known:
                                entered = m
                            if vertices[g, m] == keep:
                                into = m
                        keep = vertices[g, entered]
                        f, leave = g, into
                    neighbours[new, j] = births[f, leave]
        for s in range(seen):
            marks[visible[s], 0] = -1
        for f in range(start, count):
            marks[f, 0] = 0
    return lower if lower > ZERO else 0.0
