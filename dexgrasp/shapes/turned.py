"""Bodies of revolution about z: full ones, thin-walled ones, rings."""

import manifold3d
import numpy as np
from numpy.typing import ArrayLike

from dexgrasp.shapes.outline import Points, dent, runs, thin
from dexgrasp.shapes.solid import Solid

SEGMENTS = 48
"""Facets round a fine body of revolution."""
TOLERANCE = 6e-4
"""How far (m) a part may leave the outline of a full body."""
WALL_TOLERANCE = 1e-3
"""How far (m) a part may leave the outline of a wall, and half the height of a sector's chord."""


def _revolve(outline: Points) -> manifold3d.Manifold:
    return manifold3d.Manifold.revolve(manifold3d.CrossSection([outline]), SEGMENTS)


def _circle(radius: float, z: float, count: int) -> Points:
    """A regular polygon that has the circle's area, so that the volume is kept."""
    if radius < 1e-5:
        return np.array([[0, 0, z]])
    step = 2 * np.pi / count
    radius, angle = radius * np.sqrt(step / np.sin(step)), step * np.arange(count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])


def _bow(radius: float, z: float, first: float, span: float, count: int) -> Points:
    """`count` points across an angle, moved out so that the chords enclose the circle's area."""
    angle = np.linspace(first, first + span, count)
    radius = radius * (1 + (span / (count - 1)) ** 2 / 12)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])


def _sectors(radius: float) -> int:
    return int(np.clip(np.ceil(np.pi / np.sqrt(4 * WALL_TOLERANCE / radius)), 8, 20))


def lathe(outline: ArrayLike) -> Solid:
    """A full body by its outline (K 2: radius, z; m), z never falling; its parts are slices."""
    line = np.asarray(outline, dtype=float)
    body = _revolve(np.vstack([[0, line[0, 1]], line, [0, line[-1, 1]]]))
    parts, start = [], 0
    while start < len(line) - 1:
        stop = start + 2
        while stop < len(line):
            chunk = line[start : stop + 1]
            if dent(chunk) > TOLERANCE or thin(chunk, 4, TOLERANCE / 3)[1] > TOLERANCE:
                break
            stop += 1
        chunk, _ = thin(line[start:stop], 4, TOLERANCE / 3)
        count = min(24, 64 // len(chunk))
        parts.append(np.vstack([_circle(radius, z, count) for radius, z in chunk]))
        start = stop - 1
    return Solid(body, tuple(parts))


def shell(outline: ArrayLike, wall: float) -> Solid:
    """A vessel by its outer outline (K 2: radius, z; m) from the axis to the rim, `wall` (m) thick, rim rounded.

    The outline starts flat on the axis; its floor is one part, its wall bands of sectors.
    """
    outer = np.asarray(outline, dtype=float)
    tangent = np.gradient(outer, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent[0] = (1, 0)
    inner = outer + wall * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    inner[0, 0] = 0
    angle = np.linspace(0, np.pi, 6)[1:-1, None]
    rim = (outer[-1] + inner[-1]) / 2 + np.cos(angle) * (outer[-1] - inner[-1]) / 2
    body = _revolve(np.vstack([outer, rim + np.sin(angle) * wall / 2 * tangent[-1], inner[::-1]]))

    flat = int(np.flatnonzero(np.abs(outer[:, 1] - outer[0, 1]) < 1e-4).max())
    parts = [np.vstack([_circle(line[flat, 0], line[0, 1], 24) for line in (outer, inner)])]
    rest_out, rest_in = outer[flat:].copy(), inner[flat:].copy()
    # Two thirds of a half-round rim by height have its volume, nearly.
    rest_out[-1] += wall / 3 * tangent[-1]
    rest_in[-1] += wall / 3 * tangent[-1]
    for run in runs(rest_out, WALL_TOLERANCE):
        out, into = rest_out[run], rest_in[run]
        sectors = _sectors(float(out[:, 0].max()))
        span = 2 * np.pi / sectors
        picks = sorted({0, len(out) // 2, len(out) - 1})
        for first in span * np.arange(sectors):
            rings = [_bow(r, z, first, span, 3) for r, z in out[picks]]
            parts.append(np.vstack(rings + [_bow(r, z, first, span, 2) for r, z in into[[0, -1]]]))
    return Solid(body, tuple(parts))


def ring(radius: float, thickness: float) -> Solid:
    """A torus in the xy plane: radius (m) of its centre line and of its section."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    section = np.column_stack([radius + thickness * np.cos(turn), thickness * np.sin(turn)])
    grow = np.sqrt(2 * np.pi / 8 / np.sin(2 * np.pi / 8))
    sectors = _sectors(radius + thickness)
    span = 2 * np.pi / sectors
    coarse = [radius, 0] + grow * (section[::3] - [radius, 0])
    parts = [np.vstack([_bow(r, z, first, span, 2) for r, z in coarse]) for first in span * np.arange(sectors)]
    return Solid(_revolve(section), tuple(parts))
