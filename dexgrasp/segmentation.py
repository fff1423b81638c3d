"""Objects in a cloud by geometry alone: what stands on the table, in pieces that hang together."""

import importlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dexgrasp.concavity import pieces
from dexgrasp.connected import connected
from dexgrasp.errors import DexgraspError

Array = NDArray[np.float64]
Labels = NDArray[np.int64]
Segmenter = Callable[[Array, Array | None], Labels]
"""(points (P, 3) in the camera frame, m; table_T_camera (4, 4) or None) -> (P,) object of each point, -1 for none."""

LOWEST, HIGHEST = 0.008, 0.5
"""Heights above the table (m) between which points belong to objects."""
GAP = 0.012
"""Points farther apart than this (m) belong to different objects, unless others bridge the gap."""
CELL = 0.004
"""Side of the cubes of which each counts once, m."""
FEWEST = 40
"""Cubes of the smallest object."""


def clusters(points: Array, table_T_camera: Array | None, normals: Array | None = None) -> Labels:
    """Return the object of each point, the largest first, -1 for the table and for what is too small.

    Euclidean clustering (Rusu 2009) of what is above the table; of everything where no table is seen. With outward
    `normals` (P, 3), things that touch are told apart where the surface between them is concave.
    """
    labels = np.full(len(points), -1)
    if table_T_camera is None:
        inside = np.ones(len(points), dtype=bool)
    else:
        height = points @ table_T_camera[2, :3] + table_T_camera[2, 3]
        inside = (height > LOWEST) & (height < HIGHEST)
    if not inside.any():
        return labels
    first, owner = thinned(points[inside], CELL)
    cells = points[inside][first]
    found = connected(cells, GAP)
    if normals is not None:
        found = _parted(cells, normals[inside][first], found)
    sizes = np.bincount(found)
    order = np.argsort(-sizes, kind="stable")
    rank = np.full(len(sizes), -1)
    large = order[sizes[order] >= FEWEST]
    rank[large] = np.arange(len(large))
    labels[inside] = rank[found][owner]
    return labels


def _parted(points: Array, normals: Array, found: Labels) -> Labels:
    """Return what hangs together cut into its `pieces`."""
    result, count = found.copy(), int(found.max()) + 1
    for number in range(count):
        own = np.flatnonzero(found == number)
        piece = pieces(points[own], normals[own], FEWEST)
        result[own[piece > 0]] = count + piece[piece > 0] - 1
        count += int(piece.max())
    return result


def thinned(points: Array, side: float) -> tuple[Labels, Labels]:
    """Return the first point of each occupied cube, and the cube of each point."""
    cells = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
    spans = cells.max(axis=0) + 1
    if float(spans[0]) * float(spans[1]) * float(spans[2]) > 2**62:
        raise DexgraspError("points within some metres", f"extents of {spans * side} m", "check scale")
    _, first, owner = np.unique(
        (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2], return_index=True, return_inverse=True
    )
    return first, owner.reshape(-1)


def load_segmenter(name: str | None) -> Segmenter | None:
    """Return the function that ``module:function`` names; None for None. Raises DexgraspError where there is none."""
    if name is None:
        return None
    module, _, function = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise DexgraspError(
            "a segmenter as module:function", f"{name!r}: {error}", "check the name, and that it is installed"
        ) from error
    if not callable(found):
        raise DexgraspError("a segmenter as module:function", f"{name!r}, which is no function", "correct the name")
    return _checking(found, name)


def _checking(segmenter: Segmenter, name: str) -> Segmenter:
    def run(points: Array, table_T_camera: Array | None) -> Labels:
        labels = np.asarray(segmenter(points, table_T_camera))
        if labels.shape != (len(points),) or labels.dtype.kind not in "iu":
            raise DexgraspError(
                f"whole numbers of shape ({len(points)},) from {name}", f"{labels.dtype} {labels.shape}", "correct it"
            )
        return np.asarray(labels.astype(np.int64))

    return run
