"""Lazy 6-D quickhull: distance from the origin to the boundary of the convex hull of wrenches, certified.

h(u), how far the hull reaches along any unit u, bounds epsilon from above; the smallest signed facet distance of any
polytope inside the hull bounds it from below. The polytope grows only at the facet nearest the origin until both
bounds meet, so most facets of the whole hull are never built. Its lists are flat and reused from set to set: facet f
has its plane at planes[8 f] (unit outward normal, signed distance of the origin, height of the point being added) and
its links at links[16 f] (6 corners, the facets across from them, state). Loops avoid branches that depend on data.
"""

import numpy as np
from numba import njit

from dexgrasp.heap import pop, push
from dexgrasp.wrench_support import (
    DIM,
    ZERO,
    determinant,
    dot,
    plane,
    random_words,
    row,
    simplex,
    simplex_normals,
    support,
)

COPLANAR = 1e-11
"""Points this little above a facet's plane (wrenches of order 1) count as on it: the facet is final, bounds have met.
A set that is torn by rounding all the same is done again with ten times as much, up to"""
COARSEST = 1e-7
GENERIC = 1e-13
"""The same for volumes of L1 hulls: every facet counts, and wrenches are in general position."""
DISTANCE, EDGE, STATE = 6, 6, 12
"""Columns: a plane's distance, the facets across, whether a facet is gone (odd)."""
SIZE, DECIDE, FACET, VOLUME = range(4)
"""What is wanted: epsilon, whether it reaches the threshold, epsilon and its facet, the volume of the whole hull."""
ONCE, TWICE = np.uint32(1 << 24), np.uint32(1 << 25)
"""Added to a facet's number to count how many facets share a ridge."""
FULL, TORN = -1.0, -2.0


@njit(cache=True)
def evaluate(
    sets: np.ndarray, contacts: int, threshold: float, wanted: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return epsilon (or volume) (N,) of wrench sets (N, W, 6), a normal (N, 6) and the facet's wrenches (N, 6).

    A set certified to lie below `threshold` gives 0; with DECIDE, one certified to reach it gives a lower bound that
    is at least `threshold` instead of the exact value. NaN: rounding won. With FACET, the normal is that of the hull's
    facet nearest the origin where epsilon > 0, and its wrenches are numbered (L1); elsewhere the hull reaches no
    farther than ZERO along the normal (0: the set is flat). `contacts` as in wrench_support.
    """
    count = sets.shape[1]
    result, normals, names = np.zeros(len(sets)), np.zeros((len(sets), DIM)), np.full((len(sets), DIM), -1)
    wrenches, rest, values = np.empty((DIM, count)), np.empty((DIM, count)), np.empty(count)
    axes, first = np.empty((DIM, DIM)), np.empty((DIM + 1, DIM))
    least = GENERIC if wanted == VOLUME and contacts == 0 else COPLANAR
    room, n, tolerance = 512, 0, least
    while n < len(sets):
        # On a set that needs more room than there is, start over with twice as much.
        planes, links, hashes = np.empty(8 * room), np.empty(16 * room, np.uint32), np.empty(room, np.uint64)
        keys, items = np.empty(room), np.empty(room, np.uint32)
        visible, ridges = np.empty(room, np.uint32), np.empty(2 * room, np.uint32)
        table, pairs = np.empty(32 * room, np.uint64), np.empty(32 * room, np.uint32)
        corners, words, named = np.empty((room, DIM)), random_words(room), np.empty(room, np.int64)
        room *= 2
        while n < len(sets):
            for i in range(count):
                for k in range(DIM):
                    wrenches[k, i] = sets[n, i, k]
            if simplex(wrenches, contacts, rest, values, corners, axes, named):
                simplex_normals(corners, axes, first)
                _begin(planes, links, hashes, corners, words, first)
                found = _grow(
                    planes, links, hashes, keys, items, visible, ridges, table, pairs, corners, words, named, wrenches,
                    contacts, values, threshold, wanted, tolerance, normals[n], names[n],
                )  # fmt: skip
                if found == FULL:
                    break
                if found == TORN and tolerance < COARSEST:
                    tolerance *= 10.0
                    continue
                result[n] = np.nan if found == TORN else found
            tolerance = least
            n += 1
    return result, normals, names


@njit(cache=True)
def _begin(
    planes: np.ndarray,
    links: np.ndarray,
    hashes: np.ndarray,
    corners: np.ndarray,
    words: np.ndarray,
    normals: np.ndarray,
) -> None:
    """Write the facets of the simplex of the first 7 corners."""
    for f in range(DIM + 1):
        slot, code = 0, np.uint64(0)
        for v in range(DIM + 1):
            if v != f:
                links[16 * f + slot] = links[16 * f + EDGE + slot] = v
                slot, code = slot + 1, code ^ words[v]
        hashes[f], links[16 * f + STATE] = code, 0
        for k in range(DIM):
            planes[8 * f + k] = normals[f, k]
        planes[8 * f + DISTANCE] = dot(row(normals, f), row(corners, 1 if f == 0 else 0))


@njit(cache=True, error_model="numpy")
def _grow(
    planes: np.ndarray, links: np.ndarray, hashes: np.ndarray, keys: np.ndarray, items: np.ndarray,
    visible: np.ndarray, ridges: np.ndarray, table: np.ndarray, pairs: np.ndarray, corners: np.ndarray,
    words: np.ndarray, named: np.ndarray, wrenches: np.ndarray, contacts: int, values: np.ndarray,
    threshold: float, wanted: int, tolerance: float, normal: np.ndarray, names: np.ndarray,
) -> float:  # fmt: skip
    count, apex, turn, heap = DIM + 1, DIM, 0, 0
    for f in range(DIM + 1):
        heap = push(keys, items, heap, planes[8 * f + DISTANCE], np.uint32(f))
    upper = np.inf
    while True:
        while heap > 0 and links[16 * items[0] + STATE] & 1:
            heap = pop(keys, items, heap)
        if heap == 0:
            break
        facet = items[0]
        heap = pop(keys, items, heap)
        lower = planes[8 * facet + DISTANCE]
        if wanted != VOLUME and lower >= upper - tolerance:
            upper = min(lower, upper)
            break
        if wanted == DECIDE and lower >= threshold:
            return lower
        apex += 1
        if apex == len(words):
            return FULL
        u = plane(planes, facet)
        reach, named[apex] = support(wrenches, contacts, u, values, corners, apex)
        if wanted == VOLUME:
            if reach - lower <= tolerance:
                apex -= 1
                continue
        elif reach < upper:
            upper = reach
            normal[0], normal[1], normal[2], normal[3], normal[4], normal[5] = u
            if upper <= ZERO or upper < threshold:
                return 0.0
            if reach - lower <= tolerance:
                upper = lower
                break
        p = row(corners, apex)

        # Facets that the apex sees, by walking from the one it was found on, and the ridges where they end.
        turn += 2
        seen, head, horizon = 1, 0, 0
        visible[0] = facet
        links[16 * facet + STATE] = turn + 1
        planes[8 * facet + 7] = reach - lower
        while head < seen:
            f = visible[head]
            head += 1
            if horizon + DIM > len(visible) or seen + DIM > len(visible):
                return FULL
            for k in range(DIM):
                g = links[16 * f + EDGE + k]
                height = dot(plane(planes, g), p) - planes[8 * g + DISTANCE]
                planes[8 * g + 7] = height
                sees = height > tolerance
                ridges[2 * horizon], ridges[2 * horizon + 1] = f, k
                horizon += 1 - sees
                visible[seen] = g
                seen += sees & (links[16 * g + STATE] != turn + 1)
                links[16 * g + STATE] = turn + sees
        if count + horizon > len(hashes):
            return FULL

        # A new plane goes through ridge and apex: it is of the pencil of the two planes that meet at the ridge.
        for r in range(horizon):
            new, f = np.uint32(count + r), ridges[2 * r]
            g = links[16 * f + EDGE + ridges[2 * r + 1]]
            a, b, x, y = planes[8 * f + 7], planes[8 * g + 7], plane(planes, g), plane(planes, f)
            b = b if b < -tolerance else 0.0
            n0, n1, n2 = a * x[0] - b * y[0], a * x[1] - b * y[1], a * x[2] - b * y[2]
            n3, n4, n5 = a * x[3] - b * y[3], a * x[4] - b * y[4], a * x[5] - b * y[5]
            x = n0, n1, n2, n3, n4, n5
            scale, at = 1.0 / np.sqrt(dot(x, x)), 8 * new
            if scale * tolerance > 1.0:
                return TORN
            planes[at], planes[at + 1], planes[at + 2], planes[at + 3] = n0 * scale, n1 * scale, n2 * scale, n3 * scale
            planes[at + 4], planes[at + 5], planes[at + DISTANCE] = n4 * scale, n5 * scale, dot(x, p) * scale

        # Two new facets meet where all corners but one are the same: their numbers meet in one cell of a hash table.
        cells = 64
        while cells < 16 * horizon:
            cells *= 2
        mask = np.uint64(cells - 1)
        table[:cells], pairs[:cells] = 0, 0
        for r in range(horizon):
            new, f, k = np.uint32(count + r), ridges[2 * r], ridges[2 * r + 1]
            g = links[16 * f + EDGE + k]
            code = hashes[f] ^ words[links[16 * f + k]] ^ words[apex]
            hashes[new] = code
            for j in range(DIM):
                links[16 * new + j] = links[16 * f + j]
                links[16 * g + EDGE + j] = new if links[16 * g + EDGE + j] == f else links[16 * g + EDGE + j]
            links[16 * new + k] = links[16 * f + DIM - 1]
            links[16 * new + DIM - 1], links[16 * new + EDGE + DIM - 1], links[16 * new + STATE] = apex, g, 0
            for j in range(DIM - 1):
                key = code ^ words[links[16 * new + j]]
                cell = key & mask
                while (table[cell] != key) & (table[cell] != 0):
                    cell = (cell + np.uint64(1)) & mask
                table[cell] = key
                pairs[cell] = (pairs[cell] + ONCE) ^ new
                links[16 * new + EDGE + j] = np.uint32(cell)
        odd = np.uint32(0)
        for r in range(horizon):
            new = np.uint32(count + r)
            for j in range(DIM - 1):
                across = pairs[links[16 * new + EDGE + j]] ^ new ^ TWICE
                links[16 * new + EDGE + j] = across
                odd |= across
            if planes[8 * new + DISTANCE] < upper:
                heap = push(keys, items, heap, planes[8 * new + DISTANCE], new)
        if odd >= ONCE:
            return TORN
        count += horizon
    if wanted == VOLUME:
        return _volume(planes, links, corners, count)
    if wanted == FACET:
        facet, lower = np.uint32(0), np.inf
        for f in range(count):
            if links[16 * f + STATE] & 1 == 0 and planes[8 * f + DISTANCE] < lower:
                facet, lower = np.uint32(f), planes[8 * f + DISTANCE]
        for k in range(DIM):
            normal[k], names[k] = planes[8 * facet + k], named[links[16 * facet + k]]
    return upper


@njit(cache=True)
def _volume(planes: np.ndarray, links: np.ndarray, corners: np.ndarray, count: int) -> float:
    """Sum the simplices that facets span with the origin, negative where it lies outside the facet."""
    total, matrix = 0.0, np.empty((DIM, DIM))
    for f in range(count):
        if links[16 * f + STATE] & 1 == 0:
            for k in range(DIM):
                matrix[k] = corners[links[16 * f + k]]
            total += abs(determinant(matrix)) * np.sign(planes[8 * f + DISTANCE])
    return total / 720.0
