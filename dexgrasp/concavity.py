"""Objects that touch, told apart where the surface between them is concave (Stein et al. 2014, in kind).

Where two things touch, neighbouring normals turn towards each other; on one thing they mostly turn apart. What lies in
such a valley is left out, the rest falls into pieces, and each point of the valley goes to the piece nearest to it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dexgrasp.connected import connected

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

NEAR = 0.012
"""Points nearer than this (m) are neighbours."""
BEND = 0.14
"""Two neighbours face each other if their normals, along the line between them, turn towards each other by this."""
SHARE = 0.15
"""A point lies in a valley if more than this share of its neighbours face it."""
APART = 0.009
"""Points of pieces that valleys part are farther from each other than this, m."""
ROUNDS = 2
"""So many times each normal is averaged with its neighbours'."""
BORDER = 0.3
"""Pieces are one where less than this share of the neighbours across their border face each other."""


def pieces(points: Array, normals: Array, fewest: int) -> Labels:
    """Return the piece of each point (P, 3) of what hangs together, counted from 0; all 0 where it is one.

    `normals` point outwards. Points are evenly thinned, some millimetres apart; no piece has less than `fewest`.
    """
    one = np.zeros(len(points), dtype=np.int64)
    if len(points) < 2 * fewest:
        return one
    pairs = cKDTree(points).query_pairs(NEAR, output_type="ndarray")
    if not len(pairs):
        return one
    facing = _facing(points, _smoothed(normals, pairs), pairs)
    every, some = (np.bincount(part.ravel(), minlength=len(points)) for part in (pairs, pairs[facing]))
    solid = np.flatnonzero(some <= SHARE * every)
    if not len(solid):
        return one
    found = connected(points[solid], APART)
    large = np.bincount(found)[found] >= fewest
    if len(np.unique(found[large])) < 2:
        return one
    labels = found[large][cKDTree(points[solid[large]]).query(points)[1]]
    return _joined(labels, pairs, facing)


def _smoothed(normals: Array, pairs: Labels) -> Array:
    for _ in range(ROUNDS):
        total = normals.copy()
        np.add.at(total, pairs[:, 0], normals[pairs[:, 1]])
        np.add.at(total, pairs[:, 1], normals[pairs[:, 0]])
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
    return normals


def _facing(points: Array, normals: Array, pairs: Labels) -> NDArray[np.bool_]:
    way = points[pairs[:, 1]] - points[pairs[:, 0]]
    turned = normals[pairs[:, 1]] - normals[pairs[:, 0]]
    return np.asarray((way * turned).sum(axis=1) < -BEND * np.linalg.norm(way, axis=1))


def _joined(labels: Labels, pairs: Labels, facing: NDArray[np.bool_]) -> Labels:
    """Join pieces whose common border is hardly concave, the least concave first."""
    while True:
        sides = np.sort(labels[pairs], axis=1)
        across = sides[:, 0] != sides[:, 1]
        if not across.any():
            break
        borders, which = np.unique(sides[across], axis=0, return_inverse=True)
        share = np.bincount(which.ravel(), weights=facing[across]) / np.bincount(which.ravel())
        least = int(share.argmin())
        if share[least] >= BORDER:
            break
        labels = np.where(labels == borders[least, 1], borders[least, 0], labels)
    return np.asarray(np.unique(labels, return_inverse=True)[1], dtype=np.int64)
