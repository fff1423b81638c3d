"""A solid told twice at once: its exact surface, and convex parts for physics that cover it tightly."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import manifold3d
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Points = NDArray[np.float64]

SEGMENTS = 48
"""Facets round a fine body of revolution."""
TOLERANCE = 6e-4
"""How far (m) a convex part may leave the surface of a curved primitive, roughly."""


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


def hull(points: ArrayLike) -> Solid:
    """The convex hull of points; its physics part has at most 64 of them and the same volume."""
    body = manifold3d.Manifold.hull_points(np.asarray(points, dtype=float))
    vertices = np.asarray(body.to_mesh64().vert_properties)
    if len(vertices) <= 64:
        return Solid(body, (vertices,))
    for count in (400, 200, 128, 96, 80, 64):
        kept = np.unique((vertices @ fibonacci(count).T).argmax(axis=0))
        if len(kept) <= 64:
            break
    centre = vertices.mean(axis=0)
    grow = (body.volume() / manifold3d.Manifold.hull_points(vertices[kept]).volume()) ** (1 / 3)
    return Solid(body, (centre + grow * (vertices[kept] - centre),))


def balls(centres: ArrayLike, radii: ArrayLike, fine: int = 4) -> Solid:
    """The convex hull of some balls: ball, capsule, rounded box or prism, by the centres (m) and radii (m)."""
    centres, radii = np.atleast_2d(np.asarray(centres, dtype=float)), np.asarray(radii, dtype=float)
    radii = np.broadcast_to(radii, len(centres))

    def spread(directions: Points) -> Points:
        return (centres[:, None] + radii[:, None, None] * directions).reshape(-1, 3)

    solid = hull(spread(octasphere(8 if len(centres) < 3 else fine)))
    if len(centres) < 3:
        return solid
    coarse = manifold3d.Manifold.hull_points(spread(octasphere(2)))
    if coarse.num_vert() > 64:
        return solid
    return Solid(solid.body, (np.asarray(coarse.to_mesh64().vert_properties),))


def box(size: ArrayLike, edge: float = 0.003) -> Solid:
    """A box of the given extents (m), centred, its edges rounded by the radius `edge` (m)."""
    half = np.asarray(size, dtype=float) / 2
    edge = min(edge, 0.98 * half.min())
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return balls(signs * (half - edge), edge)


def ellipsoid(semi_axes: ArrayLike) -> Solid:
    """An ellipsoid about the origin by its semi-axes (m)."""
    return hull(octasphere(12) * np.asarray(semi_axes, dtype=float))


def prism(corners: ArrayLike, height: float, edge: float = 0.003) -> Solid:
    """A convex polygon (K 2, m) raised to z = +-height/2, its edges rounded by the radius `edge` inside its outline."""
    flat = np.asarray(corners, dtype=float)
    centre = flat.mean(axis=0)
    inset = centre + (flat - centre) * (1 - edge / np.linalg.norm(flat - centre, axis=1).min())
    levels = [np.column_stack([inset, np.full(len(flat), side * (height / 2 - edge))]) for side in (-1, 1)]
    return balls(np.vstack(levels), edge)


def fillet(profile: ArrayLike, cut: float = 0.005, steps: int = 4) -> Points:
    """Round the inner corners of a polyline (K D, m) by parabolas that start `cut` (m) before the corner."""
    line = np.asarray(profile, dtype=float)
    out = [line[:1]]
    t = np.linspace(0, 1, steps + 1)[:, None]
    for before, corner, after in zip(line, line[1:], line[2:], strict=False):
        back, ahead = before - corner, after - corner
        start = corner + back * min(0.5, cut / np.linalg.norm(back))
        end = corner + ahead * min(0.5, cut / np.linalg.norm(ahead))
        out.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    joined = np.vstack([*out, line[-1:]])
    return joined[np.r_[True, np.linalg.norm(np.diff(joined, axis=0), axis=1) > 1e-6]]


def _runs(line: Points, tolerance: float) -> list[slice]:
    """Cut a polyline greedily into runs that leave their chord by `tolerance` at most."""
    cuts, start = [], 0
    for end in range(2, len(line)):
        chord = line[end] - line[start]
        offset = line[start : end + 1] - line[start]
        unit = chord / max(float(np.linalg.norm(chord)), 1e-12)
        away = np.linalg.norm(offset - (offset @ unit)[:, None] * unit, axis=1)
        if away.max() > tolerance:
            cuts.append(slice(start, end))
            start = end - 1
    return [*cuts, slice(start, len(line))]


def _ring(radius: float, z: float, count: int, first: float = 0.0, span: float = 2 * np.pi) -> Points:
    """`count` points of a circle; a full one has the circle's area, so that the volume is kept."""
    full = span > 6.28
    angle = first + span * np.arange(count) / (count if full else count - 1)
    if full:
        radius = radius * np.sqrt(2 * np.pi / count / np.sin(2 * np.pi / count))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])


def lathe(profile: ArrayLike) -> Solid:
    """A solid of revolution about z by its outline (K 2: radius, z; m), z never falling."""
    line = np.asarray(profile, dtype=float)
    closed = np.vstack([[0, line[0, 1]], line, [0, line[-1, 1]]])
    body = manifold3d.Manifold.revolve(manifold3d.CrossSection([closed]), SEGMENTS)
    parts, start = [], 0
    while start < len(line) - 1:
        end = start + 1
        while end + 1 < len(line) and _bulge(line[start : end + 2]) < TOLERANCE:
            end += 1
        chunk = _thin(line[start : end + 1])
        count = min(32, 64 // len(chunk))
        parts.append(np.vstack([_ring(radius, z, count) if radius > 1e-5 else [[0, 0, z]] for radius, z in chunk]))
        start = end
    return Solid(body, tuple(parts))


def _bulge(line: Points) -> float:
    """How far (m) a run of an outline lies inside its own convex hull (towards larger radius)."""
    upper: list[int] = []
    for index, point in enumerate(line):
        while len(upper) > 1:
            a, b = line[upper[-2]], line[upper[-1]]
            if (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0]) > 0:
                break
            upper.pop()
        upper.append(index)
    worst = 0.0
    for first, last in pairwise(upper):
        chord = line[last] - line[first]
        offset = line[first : last + 1] - line[first]
        worst = max(worst, float(np.abs(offset @ [-chord[1], chord[0]]).max() / max(np.linalg.norm(chord), 1e-9)))
    return worst


def _thin(line: Points, most: int = 5) -> Points:
    """At most `most` points of a polyline, dropping first those that change it least."""
    kept = list(range(len(line)))
    while len(kept) > 2:
        areas = [
            abs(float(np.cross(np.r_[line[b] - line[a], 0], np.r_[line[c] - line[a], 0])[2]))
            / max(float(np.linalg.norm(line[c] - line[a])), 1e-9)
            for a, b, c in zip(kept, kept[1:], kept[2:], strict=False)
        ]
        least = int(np.argmin(areas))
        if len(kept) <= most and areas[least] > TOLERANCE / 4:
            break
        kept.pop(least + 1)
    return line[kept]


def shell(profile: ArrayLike, wall: float) -> Solid:
    """A vessel: the outer outline (K 2: radius, z; m) from the axis to the rim, `wall` (m) thick, rim rounded."""
    outer = np.asarray(profile, dtype=float)
    tangent = np.gradient(outer, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent[0] = (1, 0)
    inner = outer + wall * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    inner[0, 0] = 0
    angle = np.linspace(0, np.pi, 6)[1:-1, None]
    side = (outer[-1] - inner[-1]) / 2
    rim = (outer[-1] + inner[-1]) / 2 + np.cos(angle) * side + np.sin(angle) * wall / 2 * tangent[-1]
    body = manifold3d.Manifold.revolve(
        manifold3d.CrossSection([np.vstack([outer, rim, inner[:0:-1], inner[:1]])]), SEGMENTS
    )
    flat = int(np.flatnonzero(np.abs(outer[:, 1] - outer[0, 1]) < 1e-4).max())
    parts = [np.vstack([_ring(outer[flat, 0], line[0, 1], 32) for line in (outer, inner)])]
    sectors = int(np.clip(np.ceil(np.pi / np.sqrt(2.6e-3 / outer[:, 0].max()) / 2) * 2, 8, 20))
    span = 2 * np.pi / sectors
    for run in _runs(outer[flat:], TOLERANCE):
        out, inn = outer[flat:][run][[0, -1]], inner[flat:][run][[0, -1]]
        if run.stop == len(outer) - flat:
            out, inn = out + [[0, 0], wall / 3 * tangent[-1]], inn + [[0, 0], wall / 3 * tangent[-1]]
        # A sector's inner chord bulges into the room and its outer chords fall short: split both errors evenly.
        grow_in, grow_out = 1 + span**2 / 24, 1 + span**2 / 96
        for sector in range(sectors):
            rings = [_ring(r * grow_out, z, 3, sector * span, span) for r, z in out]
            rings += [_ring(r * grow_in, z, 2, sector * span, span) for r, z in inn]
            parts.append(np.vstack(rings))
    return Solid(body, tuple(parts))


def tube(path: ArrayLike, radius: ArrayLike, aspect: float = 1.0, rounded: bool = True, steps: int = 16) -> Solid:
    """A bar swept along an open path (K 3, m) with radii (m, one or K); `aspect` flattens its second axis."""
    line = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(line)).copy()
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    if rounded:
        bend = np.linspace(np.pi / 2, 0, 5)[1:-1]
        first = [line[0] - tangent[0] * radii[0] * np.sin(a) for a in bend]
        last = [line[-1] + tangent[-1] * radii[-1] * np.sin(a) for a in bend[::-1]]
        line = np.vstack([line[0] - tangent[0] * radii[0], *first, line, *last, line[-1] + tangent[-1] * radii[-1]])
        caps = np.r_[0.05, np.cos(bend)]
        tangent = np.vstack([np.tile(tangent[0], (4, 1)), tangent, np.tile(tangent[-1], (4, 1))])
        radii = np.r_[radii[0] * caps, radii, radii[-1] * caps[::-1]]
    sides = _frames(tangent)

    def rings(count: int, grow: float = 1.0) -> NDArray[np.float64]:
        angle = 2 * np.pi * np.arange(count) / count
        circle = np.column_stack([np.cos(angle), aspect * np.sin(angle)]) * grow
        return line[:, None] + radii[:, None, None] * (circle @ sides)

    body = _skin(rings(steps))
    coarse = rings(10, float(np.sqrt(2 * np.pi / 10 / np.sin(2 * np.pi / 10))))
    profile = np.column_stack([line, radii])
    end = 5 if rounded else 1
    bounds = [(0, end), (len(line) - end, len(line))] if rounded else []
    middle = profile[end - 1 : len(line) - end + 1]
    runs = [(run.start + end - 1, run.stop + end - 1) for run in _runs(middle, TOLERANCE)]
    parts = []
    for start, stop in runs:
        low = 0 if rounded and start == end - 1 else start
        high = len(line) if rounded and stop == len(line) - end + 1 else stop
        picks = sorted({low, start, stop - 1, high - 1, *([low + 2] * (low < start)), *([high - 3] * (high > stop))})
        parts.append(coarse[picks].reshape(-1, 3))
    del bounds
    return Solid(body, tuple(parts))


def _frames(tangent: Points) -> NDArray[np.float64]:
    """Two unit normals at each point of a path (K 2 3), carried along without twist."""
    helper = np.eye(3)[np.abs(tangent[0]).argmin()]
    first = np.cross(tangent[0], helper)
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
    low, high = index[:-1], index[1:]
    low_right, high_right = right[:-1], right[1:]
    sides = [np.stack([low, low_right, high_right], -1), np.stack([low, high_right, high], -1)]
    fan = np.stack([np.zeros(steps - 2, dtype=int), np.arange(1, steps - 1), np.arange(2, steps)], -1)
    faces = np.vstack([*[side.reshape(-1, 3) for side in sides], index[0][fan[:, ::-1]], index[-1][fan]])
    body = manifold3d.Manifold(manifold3d.Mesh64(rings.reshape(-1, 3).copy(), faces.astype(np.uint64)))
    if body.status() != manifold3d.Error.NoError:
        raise ValueError(f"a swept bar is not a closed body: {body.status()}")
    return body


def union(solids: Sequence[Solid]) -> Solid:
    """Join solids."""
    body = manifold3d.Manifold.batch_boolean([solid.body for solid in solids], manifold3d.OpType.Add)
    return Solid(body, tuple(part for solid in solids for part in solid.parts))
