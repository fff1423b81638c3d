"""Lazy 6-D quickhull: distance from the origin to the boundary of the convex hull of wrenches, certified.

h(u), how far the hull reaches along any unit u, bounds epsilon from above; the smallest signed facet distance of any
polytope inside the hull bounds it from below. The polytope grows only at the facet nearest the origin until both
bounds meet, so most facets of the whole hull are never built. Its lists are flat and reused from set to set: facet f
has its plane at planes[8 f] (unit outward normal, signed distance of the origin, height of the point being added), its
6 corners and state at links[16 f] and the 6 facets across from the corners at links[16 f + 8]: rows of 8 are moved at
once. Loops avoid branches that depend on data.
"""

import numpy as np
from numba import njit

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
DISTANCE, HEIGHT, STATE, EDGE = 6, 7, 6, 8
"""Columns: a plane's distance and the height above it; whether a facet is gone (odd), the facets across."""
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
        visible, ridges = np.empty(room, np.uint32), np.empty(room, np.uint32)
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
    count, apex, turn, left = DIM + 1, DIM, 0, DIM + 1
    for f in range(DIM + 1):
        keys[f], items[f] = planes[8 * f + DISTANCE], f
    upper = np.inf
    while True:
        # The nearest of the facets that are still there, less those already as far as the hull reaches somewhere. A
        # pass over the few that are left costs less than a heap, most of whose facets are gone before their turn.
        lower, facet = np.inf, items[0]
        if wanted == VOLUME:
            while left > 0 and lower == np.inf:
                left -= 1
                if links[16 * items[left] + STATE] & 1 == 0:
                    facet, lower = items[left], keys[left]
        else:
            number, left = left, 0
            for i in range(number):
                f, key = items[i], keys[i]
                items[left], keys[left] = f, key
                there = (links[16 * f + STATE] & 1 == 0) & (key < upper)
                left += there
                nearer = there & (key < lower)
                facet = f if nearer else facet
                lower = key if nearer else lower
        if lower == np.inf:
            break
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
        planes[8 * facet + HEIGHT] = reach - lower
        while head < seen:
            f = visible[head]
            head += 1
            if horizon + DIM > len(visible) or seen + DIM > len(visible):
                return FULL
            for k in range(DIM):
                g = links[16 * f + EDGE + k]
                height = dot(plane(planes, g), p) - planes[8 * g + DISTANCE]
                planes[8 * g + HEIGHT] = height
                sees = height > tolerance
                ridges[horizon] = 16 * f + k
                horizon += 1 - sees
                visible[seen] = g
                seen += sees & (links[16 * g + STATE] != turn + 1)
                links[16 * g + STATE] = turn + sees
        if count + horizon > len(hashes):
            return FULL

        # A new plane goes through ridge and apex: it is of the pencil of the two planes that meet at the ridge.
        thin = False
        for r in range(horizon):
            new, f = np.uint32(count + r), ridges[r] >> 4
            g = links[ridges[r] + EDGE]
            a, b, x, y = planes[8 * f + HEIGHT], planes[8 * g + HEIGHT], plane(planes, g), plane(planes, f)
            b = b if b < -tolerance else 0.0
            n0, n1, n2 = a * x[0] - b * y[0], a * x[1] - b * y[1], a * x[2] - b * y[2]
            n3, n4, n5 = a * x[3] - b * y[3], a * x[4] - b * y[4], a * x[5] - b * y[5]
            x = n0, n1, n2, n3, n4, n5
            size, at = dot(x, x), 8 * new
            thin |= size < tolerance * tolerance
            scale = 1.0 / np.sqrt(size)
            planes[at], planes[at + 1], planes[at + 2], planes[at + 3] = n0 * scale, n1 * scale, n2 * scale, n3 * scale
            planes[at + 4], planes[at + 5], planes[at + DISTANCE] = n4 * scale, n5 * scale, dot(x, p) * scale
        if thin:
            return TORN

        # Two new facets meet where all corners but one are the same: their numbers meet in one cell of a hash table.
        cells = 64
        while cells < 16 * horizon:
            cells *= 2
        mask = np.uint64(cells - 1)
        table[:cells], pairs[:cells] = 0, 0
        for r in range(horizon):
            new, f, k = 16 * np.uint32(count + r), ridges[r] & ~np.uint32(15), ridges[r] & np.uint32(15)
            g = 16 * links[f + EDGE + k]
            code = hashes[f >> 4] ^ words[links[f + k]] ^ words[apex]
            hashes[count + r] = code
            for j in range(8):
                links[new + j] = links[f + j]
            for j in range(8):
                links[g + EDGE + j] = new >> 4 if links[g + EDGE + j] == f >> 4 else links[g + EDGE + j]
            links[new + k] = links[f + DIM - 1]
            links[new + DIM - 1], links[new + EDGE + DIM - 1], links[new + STATE] = apex, g >> 4, 0
            for j in range(DIM - 1):
                key = code ^ words[links[new + j]]
                cell = key & mask
                while (table[cell] != key) & (table[cell] != 0):
                    cell = (cell + np.uint64(1)) & mask
                table[cell] = key
                pairs[cell] = (pairs[cell] + ONCE) ^ (new >> 4)
                links[new + EDGE + j] = np.uint32(cell)
        odd = np.uint32(0)
        for r in range(horizon):
            new = np.uint32(count + r)
            for j in range(DIM - 1):
                across = pairs[links[16 * new + EDGE + j]] ^ new ^ TWICE
                links[16 * new + EDGE + j] = across
                odd |= across
            items[left], keys[left] = new, planes[8 * new + DISTANCE]
            left += keys[left] < upper
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
