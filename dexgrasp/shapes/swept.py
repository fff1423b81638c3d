"""Bars swept along a path."""

import manifold3d
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dexgrasp.shapes.outline import Points, runs
from dexgrasp.shapes.solid import Solid

TOLERANCE = 8e-4
"""How far (m) a part's straight axis may leave the path."""


def tube(path: ArrayLike, radius: ArrayLike, aspect: float = 1.0, rounded: bool = True, steps: int = 16) -> Solid:
    """A bar along an open path (K 3, m) with radii (m, one or K); `aspect` stretches its second axis.

    The first axis of the section is the one that the path's start has nearest to a coordinate axis.
    """
    line = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(line))
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    head, tail = 0, len(line)
    if rounded:
        bend = np.linspace(np.pi / 2, 0, 5)[:-1]
        reach, width = np.sin(bend)[:, None], np.maximum(np.cos(bend), 0.05)
        first, last = line[0] - radii[0] * reach * tangent[0], line[-1] + radii[-1] * reach[::-1] * tangent[-1]
        line = np.vstack([first, line, last])
        tangent = np.vstack([np.tile(tangent[0], (4, 1)), tangent, np.tile(tangent[-1], (4, 1))])
        radii = np.r_[radii[0] * width, radii, radii[-1] * width[::-1]]
        head, tail = 4, tail + 4
    sides = _frames(tangent)

    def rings(count: int, grow: float) -> NDArray[np.float64]:
        angle = 2 * np.pi * np.arange(count) / count
        circle = grow * np.column_stack([np.cos(angle), aspect * np.sin(angle)])
        return line[:, None] + radii[:, None, None] * (circle @ sides)

    coarse = rings(10, np.sqrt(2 * np.pi / 10 / np.sin(2 * np.pi / 10)))
    parts = []
    for run in runs(np.column_stack([line, radii])[head:tail], TOLERANCE):
        start, stop = run.start + head, run.stop + head
        picks = [start, stop - 1]
        if rounded:
            picks += [0, 2] * (start == head) + [len(line) - 3, len(line) - 1] * (stop == tail)
        parts.append(coarse[picks].reshape(-1, 3))
    return Solid(_skin(rings(steps, 1.0)), tuple(parts))


def _frames(tangent: Points) -> NDArray[np.float64]:
    """Two unit normals at each point of a path (K 2 3), carried along without twist."""
    first = np.eye(3)[np.abs(tangent[0]).argmin()]
    out = []
    for direction in tangent:
        first = first - (first @ direction) * direction
        first = first / np.linalg.norm(first)
        out.append((first, np.cross(direction, first)))
    return np.array(out)


def _skin(rings: NDArray[np.float64]) -> manifold3d.Manifold:
    """Close a stack of rings (K n 3) into a body."""
    count, steps = rings.shape[:2]
    index = np.arange(count * steps).reshape(count, steps)
    right = np.roll(index, -1, axis=1)
    sides = [
        np.stack([index[:-1], right[:-1], right[1:]], axis=-1).reshape(-1, 3),
        np.stack([index[:-1], right[1:], index[1:]], axis=-1).reshape(-1, 3),
    ]
    fan = np.stack([np.zeros(steps - 2, dtype=int), np.arange(1, steps - 1), np.arange(2, steps)], axis=-1)
    faces = np.vstack([*sides, index[0][fan[:, ::-1]], index[-1][fan]])
    body = manifold3d.Manifold(manifold3d.Mesh64(rings.reshape(-1, 3).copy(), faces.astype(np.uint64)))
    if body.status() != manifold3d.Error.NoError:
        raise ValueError(f"a swept bar must be a closed body: {body.status()}")
    return body
