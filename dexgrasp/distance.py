"""Signed distance to an object's surface: a grid for lower bounds, a triangle tree for exact values."""

import math
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from numba import njit

from dexgrasp.borrow import borrowed
from dexgrasp.errors import DexgraspError
from dexgrasp.quality import Array
from dexgrasp.triangle_tree import TriangleTree, nearest, to_box, to_triangle, triangle_tree

STRIDE = 4
"""Grid nodes per coarse node: away from the surface, fine nodes are bounded from coarse ones."""
BAND = 6.0
"""Nodes that may be nearer to the surface than this many spacings hold the exact distance."""
PADDING = 10
"""Spacings by which the grid reaches beyond the object."""
ROUNDING = 1e-7
"""Taken off what is stored in single precision, m."""


class Field(NamedTuple):
    """A distance field as arrays that compiled code reads (m)."""

    tree: TriangleTree
    origin: np.ndarray
    """(3,) position of node (0, 0, 0)."""
    spacing: float
    values: np.ndarray
    """(X, Y, Z) float32, at most the signed distance; exact to `ROUNDING` near the surface."""
    seeds: np.ndarray
    """(X, Y, Z) int32, a triangle that is nearest, or near."""


class DistanceField:
    """Distance to a watertight mesh in its own frame; negative inside, m."""

    def __init__(self, field: Field) -> None:
        self.field = field

    @classmethod
    def build(cls, mesh: trimesh.Trimesh, spacing: float = 0.002) -> "DistanceField":
        """Return the field of a watertight mesh (m); raises DexgraspError where inside and outside are undefined."""
        if not len(mesh.faces) or not mesh.is_watertight:
            raise DexgraspError(
                "a watertight mesh", f"{len(mesh.faces)} faces with open edges", "repair the mesh or leave it out"
            )
        tree = triangle_tree(mesh)
        low, high = tree.boxes[0, :3], tree.boxes[0, 3:]
        cells = np.ceil((high - low) / spacing / STRIDE).astype(int) * STRIDE + 2 * PADDING
        origin = (low + high) / 2 - cells * spacing / 2
        values, seeds = _fill(tree, origin, spacing, cells[0] + 1, cells[1] + 1, cells[2] + 1)
        return cls(Field(tree, origin, spacing, values, seeds))

    def distance(self, points: Array) -> Array:
        """Return the signed distance of points (P, 3): exact in the grid, at most the true one outside it (m)."""
        return self._evaluate(points, _distances)

    def lower_bound(self, points: Array) -> Array:
        """Return what the grid alone says: at most the signed distance of points (P, 3), less by up to 2 mm (m)."""
        return self._evaluate(points, _bounds)

    def nearest(self, points: Array) -> tuple[Array, Array, Array]:
        """Return signed distances (P,), nearest surface points (P, 3) and outward unit normals (P, 3), exact.

        The normal is the direction in which distance grows: that of the face, or between those that meet there.
        """
        found = self._evaluate(points, _nearest)
        return found[:, 0], found[:, 1:4], found[:, 4:7]

    def _evaluate(self, points: Array, kernel) -> Array:  # type: ignore[no-untyped-def]
        if isinstance(points, np.ndarray):
            return kernel(self.field, np.ascontiguousarray(points, dtype=np.float64))
        found = kernel(self.field, np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64))
        return torch.from_numpy(found).to(points)


@njit(cache=True)
def _fill(
    tree: TriangleTree, origin: np.ndarray, spacing: float, nx: int, ny: int, nz: int
) -> tuple[np.ndarray, np.ndarray]:
    tree, values = borrowed(tree), np.empty((nx, ny, nz), np.float32)
    seeds = np.empty((nx, ny, nz), np.int32)
    out = np.empty(7)
    seed = 0
    mx, my, mz = (nx - 1) // STRIDE + 1, (ny - 1) // STRIDE + 1, (nz - 1) // STRIDE + 1
    coarse = np.empty((mx, my, mz))
    for i in range(mx):
        for j in range(my):
            for k in range(mz):
                step = STRIDE * spacing
                seed = nearest(tree, origin[0] + i * step, origin[1] + j * step, origin[2] + k * step, seed, out)
                coarse[i, j, k] = out[0]
                seeds[i * STRIDE, j * STRIDE, k * STRIDE] = seed
    band = BAND * spacing
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                lower, upper = -np.inf, np.inf
                seed = 0
                for a in range(2):
                    for b in range(2):
                        for c in range(2):
                            u, v, w = (i // STRIDE) + a, (j // STRIDE) + b, (k // STRIDE) + c
                            if u >= mx or v >= my or w >= mz:
                                continue
                            away = spacing * math.sqrt(
                                (i - u * STRIDE) ** 2 + (j - v * STRIDE) ** 2 + (k - w * STRIDE) ** 2
                            )
                            value = coarse[u, v, w]
                            lower = max(lower, value - away)
                            if abs(value) + away < upper:
                                upper = abs(value) + away
                                seed = seeds[u * STRIDE, v * STRIDE, w * STRIDE]
                if lower < band and -lower < 4 * STRIDE * spacing:
                    x, y, z = origin[0] + i * spacing, origin[1] + j * spacing, origin[2] + k * spacing
                    seed = nearest(tree, x, y, z, seed, out)
                    lower = out[0]
                values[i, j, k] = lower - ROUNDING
                seeds[i, j, k] = seed
    return values, seeds


@njit(cache=True, error_model="numpy")
def quick_bound(
    values: np.ndarray,
    boxes: np.ndarray,
    a: float,
    b: float,
    c: float,
    h: float,
    x: float,
    y: float,
    z: float,
    far: float,
) -> float:
    """Return a lower bound of the signed distance at a point (m): from the nearest grid node alone if that is `far`.

    Else from the eight nodes about it. Let p be the point, c the surface's nearest one, and draw a node n with the
    weights of linear interpolation, whose mean is p: the interpolated value is at most E|n - c|, so that by Jensen its
    square is at most |p - c|^2 + Var n. The grid's origin is (a, b, c), its spacing h.
    """
    u, v, w = (x - a) / h, (y - b) / h, (z - c) / h
    nx, ny, nz = values.shape
    if u < 0 or v < 0 or w < 0 or u > nx - 1 or v > ny - 1 or w > nz - 1:
        return math.sqrt(to_box(boxes, 0, x, y, z))
    i, j, k = int(u + 0.5), int(v + 0.5), int(w + 0.5)
    p, q, r = u - i, v - j, w - k
    bound = values[i, j, k] - h * math.sqrt(p * p + q * q + r * r)
    if bound >= far:
        return bound
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    u, v, w = u - i, v - j, w - k
    low = (1 - v) * ((1 - w) * values[i, j, k] + w * values[i, j, k + 1])
    low += v * ((1 - w) * values[i, j + 1, k] + w * values[i, j + 1, k + 1])
    high = (1 - v) * ((1 - w) * values[i + 1, j, k] + w * values[i + 1, j, k + 1])
    high += v * ((1 - w) * values[i + 1, j + 1, k] + w * values[i + 1, j + 1, k + 1])
    mean = (1 - u) * low + u * high
    square = mean * mean - h * h * (u * (1 - u) + v * (1 - v) + w * (1 - w))
    return max(bound, math.sqrt(square)) if mean > 0 and square > 0 else bound


@njit(cache=True, error_model="numpy")
def interpolated(field: Field, x: float, y: float, z: float) -> float:
    """Return the signed distance at a point as the grid's eight nodes about it tell it: nearly right, no bound (m)."""
    origin = field.origin
    return trilinear(field.values, field.tree.boxes, origin[0], origin[1], origin[2], field.spacing, x, y, z)


@njit(cache=True, error_model="numpy")
def trilinear(
    values: np.ndarray, boxes: np.ndarray, a: float, b: float, c: float, h: float, x: float, y: float, z: float
) -> float:
    """Return what `interpolated` does from a field's arrays, its origin (a, b, c) and spacing h.

    For hot loops: a small function that takes a whole `Field` spends most of its time counting references.
    """
    u, v, w = (x - a) / h, (y - b) / h, (z - c) / h
    nx, ny, nz = values.shape
    if u < 0 or v < 0 or w < 0 or u > nx - 1 or v > ny - 1 or w > nz - 1:
        return math.sqrt(to_box(boxes, 0, x, y, z))
    i, j, k = min(int(u), nx - 2), min(int(v), ny - 2), min(int(w), nz - 2)
    u, v, w = u - i, v - j, w - k
    low = (1 - v) * ((1 - w) * values[i, j, k] + w * values[i, j, k + 1])
    low += v * ((1 - w) * values[i, j + 1, k] + w * values[i, j + 1, k + 1])
    high = (1 - v) * ((1 - w) * values[i + 1, j, k] + w * values[i + 1, j, k + 1])
    high += v * ((1 - w) * values[i + 1, j + 1, k] + w * values[i + 1, j + 1, k + 1])
    return (1 - u) * low + u * high


@njit(cache=True)
def seed_at(field: Field, x: float, y: float, z: float) -> int:
    """Return a triangle near a point."""
    h = field.spacing
    nx, ny, nz = field.values.shape
    i = min(max(int((x - field.origin[0]) / h + 0.5), 0), nx - 1)
    j = min(max(int((y - field.origin[1]) / h + 0.5), 0), ny - 1)
    k = min(max(int((z - field.origin[2]) / h + 0.5), 0), nz - 1)
    return field.seeds[i, j, k]


@njit(cache=True, error_model="numpy")
def nearly(field: Field, x: float, y: float, z: float, out: np.ndarray) -> None:
    """Write what `nearest` would, mostly exactly, from the triangles that the eight nodes about a point name.

    The point lies outside the object, clear of its surface.
    """
    h, corners = field.spacing, field.tree.corners
    nx, ny, nz = field.values.shape
    i = min(max(int((x - field.origin[0]) / h), 0), nx - 2)
    j = min(max(int((y - field.origin[1]) / h), 0), ny - 2)
    k = min(max(int((z - field.origin[2]) / h), 0), nz - 2)
    best, last, other, v, w, triangle = np.inf, -1, -1, 0.0, 0.0, 0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                seed = field.seeds[i + a, j + b, k + c]
                if seed != last and seed != other:
                    square, v_t, w_t, _ = to_triangle(corners, seed, x, y, z)
                    if square < best:
                        best, v, w, triangle = square, v_t, w_t, seed
                    last, other = seed, last
    out[0] = math.sqrt(best)
    point = (x, y, z)
    for m in range(3):
        a0 = corners[triangle, 0, m]
        out[1 + m] = a0 + v * (corners[triangle, 1, m] - a0) + w * (corners[triangle, 2, m] - a0)
        out[4 + m] = (point[m] - out[1 + m]) / max(out[0], 1e-300)


@njit(cache=True)
def _nearest(field: Field, points: np.ndarray) -> np.ndarray:
    field, found = borrowed(field), np.empty((len(points), 7))
    for i in range(len(points)):
        x, y, z = points[i]
        nearest(field.tree, x, y, z, seed_at(field, x, y, z), found[i])
    return found


@njit(cache=True)
def _bounds(field: Field, points: np.ndarray) -> np.ndarray:
    field, found = borrowed(field), np.empty(len(points))
    boxes, (a, b, c) = field.tree.boxes, field.origin
    for i in range(len(points)):
        x, y, z = points[i]
        found[i] = quick_bound(field.values, boxes, a, b, c, field.spacing, x, y, z, np.inf)
    return found


@njit(cache=True)
def _distances(field: Field, points: np.ndarray) -> np.ndarray:
    field, found = borrowed(field), np.empty(len(points))
    out = np.empty(7)
    nx, ny, nz = field.values.shape
    for i in range(len(points)):
        x, y, z = points[i]
        u = (points[i] - field.origin) / field.spacing
        if u.min() < 0 or u[0] > nx - 1 or u[1] > ny - 1 or u[2] > nz - 1:
            found[i] = math.sqrt(to_box(field.tree.boxes, 0, x, y, z))
        else:
            nearest(field.tree, x, y, z, seed_at(field, x, y, z), out)
            found[i] = out[0]
    return found
