"""A solid told twice at once: its exact surface, and convex parts for physics that cover it tightly."""

from dataclasses import dataclass

import manifold3d
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Points = NDArray[np.float64]

MOST_VERTICES = 64
"""Vertices of a convex part: more make physics slow."""


@dataclass(frozen=True)
class Solid:
    """A closed body (m) and the vertices of its convex parts, at most 64 each. Unions keep both in step."""

    body: manifold3d.Manifold
    parts: tuple[Points, ...]

    def __or__(self, other: "Solid") -> "Solid":
        return Solid(self.body + other.body, self.parts + other.parts)

    def at(self, translation: ArrayLike = (0, 0, 0), turn: ArrayLike = (0, 0, 0)) -> "Solid":
        """Turn by fixed-axis xyz Euler angles (deg), then shift (m)."""
        rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        shift = np.asarray(translation, dtype=float)
        affine = np.column_stack([rotation, shift])
        return Solid(self.body.transform(affine), tuple(part @ rotation.T + shift for part in self.parts))

    def scaled(self, factors: ArrayLike) -> "Solid":
        """Stretch along the axes by positive factors."""
        scale = np.asarray(factors, dtype=float)
        body = self.body.transform(np.column_stack([np.diag(scale), np.zeros(3)]))
        return Solid(body, tuple(part * scale for part in self.parts))


def closed(body: manifold3d.Manifold) -> manifold3d.Manifold:
    """Return the body with two faces at every edge: of a hull two may lie folded onto others, at an edge of four."""
    faces = np.asarray(body.to_mesh64().tri_verts).astype(np.int64)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    folded = (np.unique(edges, axis=0, return_counts=True)[1] != 2).any()
    return body.simplify(0.0) if folded else body


def octasphere(steps: int) -> Points:
    """Unit directions of a subdivided octahedron, 4 steps^2 + 2 of them, the axes among them."""
    grid = np.array([(a, b) for a in range(-steps, steps + 1) for b in range(-steps, steps + 1)])
    grid = grid[np.abs(grid).sum(axis=1) <= steps]
    height = steps - np.abs(grid).sum(axis=1)
    points = np.unique(np.vstack([np.column_stack([grid, height]), np.column_stack([grid, -height])]), axis=0)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def fibonacci(count: int) -> Points:
    """Unit directions spread evenly over the sphere."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])


def corners(body: manifold3d.Manifold) -> Points:
    """Vertices (V 3, m) of a body."""
    return np.asarray(body.to_mesh64().vert_properties)[:, :3].copy()


def reduced(body: manifold3d.Manifold) -> Points:
    """At most 64 vertices (m) of a convex body that tell it best, grown about its middle to keep its volume."""
    vertices = corners(body)
    if len(vertices) <= MOST_VERTICES:
        return vertices
    kept = set((vertices @ fibonacci(24).T).argmax(axis=0).tolist())
    while len(kept) < MOST_VERTICES:
        planes = ConvexHull(vertices[sorted(kept)]).equations
        outside = vertices @ planes[:, :3].T + planes[:, 3]
        # The worst vertex above each facet; of those, the farthest few.
        tops = outside.argmax(axis=0)
        height = outside[tops, np.arange(len(planes))]
        fresh = dict.fromkeys(int(tops[facet]) for facet in np.argsort(-height, kind="stable") if height[facet] > 1e-5)
        chosen = [top for top in fresh if top not in kept][: min(10, MOST_VERTICES - len(kept))]
        if not chosen:
            break
        kept.update(chosen)
    part = vertices[sorted(kept)]
    grow = (body.volume() / manifold3d.Manifold.hull_points(part).volume()) ** (1 / 3)
    return part.mean(axis=0) + grow * (part - part.mean(axis=0))


def hull(points: ArrayLike) -> Solid:
    """The convex hull of points; its physics part has at most 64 of them and the same volume."""
    body = manifold3d.Manifold.hull_points(np.asarray(points, dtype=float))
    return Solid(body, (reduced(body),))


def balls(centres: ArrayLike, radii: ArrayLike) -> Solid:
    """The convex hull of some balls: ball, capsule, rounded box or prism, by centres (N 3, m) and radii (m)."""
    middle = np.atleast_2d(np.asarray(centres, dtype=float))
    radius = np.broadcast_to(np.asarray(radii, dtype=float), len(middle))

    def spread(steps: int) -> manifold3d.Manifold:
        points = middle[:, None] + radius[:, None, None] * octasphere(steps)
        return manifold3d.Manifold.hull_points(points.reshape(-1, 3))

    body, coarse = spread(10 if len(middle) < 3 else 6), spread(2)
    close = coarse.num_vert() <= MOST_VERTICES and coarse.volume() > 0.985 * body.volume()
    return Solid(body, (corners(coarse) if close else reduced(body),))


def box(size: ArrayLike, edge: float = 0.003) -> Solid:
    """A box of the given extents (m), centred, its edges rounded by the radius `edge` (m)."""
    half = np.asarray(size, dtype=float) / 2
    edge = min(edge, 0.98 * half.min())
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return balls(signs * (half - edge), edge)


def ellipsoid(semi_axes: ArrayLike) -> Solid:
    """An ellipsoid about the origin by its semi-axes (m)."""
    axes = np.asarray(semi_axes, dtype=float)
    body = manifold3d.Manifold.hull_points(octasphere(12) * axes)
    part = fibonacci(MOST_VERTICES) * axes
    return Solid(body, (part * (body.volume() / manifold3d.Manifold.hull_points(part).volume()) ** (1 / 3),))


def prism(outline: ArrayLike, height: float, edge: float = 0.003) -> Solid:
    """A convex polygon (K 2, m) raised to z = +-height/2, with rounded edges, about `edge` (m) within its outline."""
    flat = np.asarray(outline, dtype=float)
    centre = flat.mean(axis=0)
    inset = centre + (flat - centre) * (1 - edge / np.linalg.norm(flat - centre, axis=1).min())
    levels = [np.column_stack([inset, np.full(len(flat), side * (height / 2 - edge))]) for side in (-1, 1)]
    return balls(np.vstack(levels), edge)
