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
    low = points.min(axis=0)
    side = max(side, float((points.max(axis=0) - low).max()) / (2**BITS - 4), 1e-12)
    number = ((points - low) / side).astype(np.int64) + 1
    key = (number[:, 0] << 2 * BITS) | (number[:, 1] << BITS) | number[:, 2]
    order = np.argsort(key, kind="stable")
    slots = 1 << max(4, int(2 * len(points) - 1).bit_length())
    keys, starts, stops = np.full(slots, -1), np.zeros(slots, np.int64), np.zeros(slots, np.int64)
    occupied = _fill(key[order], keys, starts, stops)
    return Cells(np.ascontiguousarray(points[order].T, np.float64), order, keys, starts, stops, low, side, occupied)


@njit(cache=True)
def find_cell(keys: np.ndarray, key: int) -> int:
    """Return the slot of a cell, or the free one where it would be."""
    mask = len(keys) - 1
    slot = ((key * 0x1E3779B97F4A7C15) >> 32) & mask
    while keys[slot] >= 0 and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True)
def _fill(sorted_keys: np.ndarray, keys: np.ndarray, starts: np.ndarray, stops: np.ndarray) -> int:
    occupied = 0
    for i in range(len(sorted_keys)):
        slot = find_cell(keys, sorted_keys[i])
        if keys[slot] < 0:
            keys[slot], starts[slot] = sorted_keys[i], i
            occupied += 1
        stops[slot] = i + 1
    return occupied
