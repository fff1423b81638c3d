"""Points in cubic cells, found by a hash of the cell: what lies near a point, without a tree."""

from typing import NamedTuple

import numpy as np
from numba import njit


class Cells(NamedTuple):
    """N points sorted by cell. Coordinates and sides in one unit."""

    points: np.ndarray
    """(3, N) float64, those of one cell together."""
    order: np.ndarray
    """(N,) their rows in the given cloud."""
    keys: np.ndarray
    """(S,) the cell that has a slot of the table; -1 for none. S is a power of two."""
    starts: np.ndarray
    """(S,) first of its points."""
    stops: np.ndarray
    """(S,) one behind its last."""
    low: np.ndarray
    """(3,) corner of the grid."""
    side: float
    occupied: int
    """Cells that hold points."""


BITS = 20
"""A cell's number along each axis has so many bits."""


def make_cells(points: np.ndarray, side: float) -> Cells:
    """Sort points (N, 3) into cells of `side`, larger where 2^20 of them would not reach."""
    points = np.ascontiguousarray(points, np.float64)
    low, high = bounds(points)
    side = max(side, float((high - low).max()) / (2**BITS - 4), 1e-12)
    slots = 1 << max(4, int(2 * len(points) - 1).bit_length())
    keys, starts, stops = np.full(slots, -1), np.zeros(slots, np.int64), np.zeros(slots, np.int64)
    sorted_points, order = np.empty((3, len(points))), np.empty(len(points), np.int64)
    occupied = _fill(points, low, side, keys, starts, stops, sorted_points, order)
    return Cells(sorted_points, order, keys, starts, stops, low, side, occupied)


@njit(cache=True)
def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest coordinates of points (N, 3), (3,) each; several times faster than numpy's."""
    low, high = points[0].copy(), points[0].copy()
    for n in range(1, len(points)):
        for axis in range(3):
            low[axis] = min(low[axis], points[n, axis])
            high[axis] = max(high[axis], points[n, axis])
    return low, high


@njit(cache=True)
def find_cell(keys: np.ndarray, key: int) -> int:
    """Return the slot of a cell, or the free one where it would be."""
    mask = len(keys) - 1
    slot = ((key * 0x1E3779B97F4A7C15) >> 32) & mask
    while keys[slot] >= 0 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True)
def _fill(
    points: np.ndarray,
    low: np.ndarray,
    side: float,
    keys: np.ndarray,
    starts: np.ndarray,
    stops: np.ndarray,
    sorted_points: np.ndarray,
    order: np.ndarray,
) -> int:
    """Fill the table and sort the points by counting; points of one cell stay in order."""
    occupied, slots = 0, np.empty(len(points), np.int64)
    for i in range(len(points)):
        a, b, c = (points[i, 0] - low[0]) / side, (points[i, 1] - low[1]) / side, (points[i, 2] - low[2]) / side
        key = ((int(a) + 1) << 2 * BITS) | ((int(b) + 1) << BITS) | (int(c) + 1)
        slot = find_cell(keys, key)
        occupied += keys[slot] < 0
        keys[slot], slots[i] = key, slot
        stops[slot] += 1
    total = 0
    for slot in range(len(keys)):
        starts[slot] = total
        total += stops[slot]
        stops[slot] = starts[slot]
    for i in range(len(points)):
        place = stops[slots[i]]
        stops[slots[i]] += 1
        order[place] = i
        for axis in range(3):
            sorted_points[axis, place] = points[i, axis]
    return occupied
