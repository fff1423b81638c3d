"""Faults of depth sensors: noise that grows with distance, blurred and jagged edges, shadows, holes, steps.

A pair of eyes (stereo, or camera and projector) measures disparity d = f b / z, so that an error of one pixel of
disparity is z^2 / (f b) of depth (Keselman et al. 2017), and sees nothing where one eye's view is blocked. Matching
windows make neighbouring errors alike and edges ragged; time of flight mixes near and far within a pixel instead.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from dexgrasp.dataset.camera import Rendering


@dataclass(frozen=True)
class Noise:
    """What a sensor does to an ideal depth image; the default is nothing."""

    sigma: float = 0.0
    """Standard deviation of each pixel's depth, m, at any distance."""
    proportional: float = 0.0
    """The same as a share of depth (time of flight)."""
    baseline: float = 0.0
    """Distance to the second eye, along the image's x, m; 0 for none: no shadows and no disparity."""
    focal: float | None = None
    """Focal length of the two eyes' own images, px of disparity; null: the camera's."""
    disparity: float = 0.0
    """Standard deviation of disparity, px; errors are alike over `grain`."""
    ripple: float = 0.0
    """Standard deviation of a slow error of disparity, px, alike over `ripple_length`."""
    ripple_length: float = 60.0
    """px"""
    clip: float = 0.005
    """Largest error of depth from all that is named above, m."""
    step: float = 0.0
    """Step of disparity, px; 0 for none."""
    quantum: float = 0.0
    """Step of the depth values, m; 0 for none."""
    lateral: float = 0.0
    """Standard deviation of where a pixel looks, px: ragged edges."""
    grain: float = 4.0
    """Distance over which errors of disparity and direction change, px."""
    edge: float = 0.01
    """Depth step between neighbouring pixels that makes an edge, m."""
    edge_dropout: float = 0.0
    """Share of pixels at edges that are lost."""
    flying: float = 0.0
    """Share of the others at edges that are measured somewhere between near and far."""
    grazing: float = 90.0
    """Incidence (deg) from which pixels begin to be lost; all are at 90."""
    dropout: float = 0.0
    """Share of pixels lost anywhere."""
    patches: float = 0.0
    """Mean number of round holes in an image."""
    patch_radius: float = 6.0
    """Largest radius of a hole, px."""

    def apply(self, rendering: Rendering, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Return depth as measured (H W, m, 0 where nothing was) and the instance that each pixel looked at."""
        camera, shape = rendering.camera, rendering.depth.shape
        depth, instance, facet = rendering.depth, rendering.instance, rendering.facet
        if self.lateral > 0:
            rows, columns = (self.lateral * _field(generator, shape, self.grain) for _ in range(2))
            depth, instance, facet = _jitter(rows, columns, depth, instance, facet)
        scale = 0.0 if self.baseline <= 0 else 1 / (self.baseline * (self.focal or camera.fx))
        lost = np.zeros(shape, dtype=bool)
        if self.baseline > 0:
            _shadow(depth, camera.fx * self.baseline, lost)
        count = generator.poisson(self.patches)
        _punch(lost, generator.uniform(0, 1, (count, 3)), self.patch_radius)
        luck = np.frombuffer(generator.bytes(4 * depth.size), np.uint16).reshape(2, *shape)
        white = generator.standard_normal(shape, dtype=np.float32)
        slow: NDArray[Any] = np.zeros((1, 1), np.float32)  # error of disparity; a single value is one for all pixels
        for share, length in ((self.disparity, self.grain), (self.ripple, self.ripple_length)):
            if share * scale > 0:
                slow = slow + share * scale * _field(generator, shape, length)
        measured = _spoil(
            depth,
            facet,
            rendering.facets,
            camera.intrinsics,
            lost,
            luck,
            white,
            slow,
            (self.sigma, self.proportional, self.clip, self.step * scale, self.quantum),
            (self.dropout, self.edge, self.edge_dropout, self.flying, np.cos(np.radians(self.grazing))),
        )
        return measured, instance


def _field(generator: np.random.Generator, shape: tuple[int, int], length: float) -> NDArray:
    """Return normal deviates (H W) that change over `length` px: between those at the nodes of a lattice."""
    rows, columns = (int(np.ceil(side / length)) + 2 for side in shape)
    return _expand(generator.standard_normal((rows, columns), dtype=np.float32), length, shape)


@numba.njit(cache=True)
def _expand(nodes: NDArray, length: float, shape: tuple[int, int]) -> NDArray:
    """Interpolate linearly between nodes, with the same variance everywhere."""
    height, width = shape
    field, between = np.empty(shape, np.float32), np.empty(nodes.shape[1], np.float32)
    left, right = np.empty(width, np.float32), np.empty(width, np.float32)
    for u in range(width):
        share = u / length - int(u / length)
        norm = np.sqrt((1 - share) ** 2 + share * share)
        left[u], right[u] = (1 - share) / norm, share / norm
    for v in range(height):
        row = int(v / length)
        share = v / length - row
        norm = np.sqrt((1 - share) ** 2 + share * share)
        for k in range(len(between)):
            between[k] = ((1 - share) * nodes[row, k] + share * nodes[row + 1, k]) / norm
        for u in range(width):
            k = int(u / length)
            field[v, u] = left[u] * between[k] + right[u] * between[k + 1]
    return field


@numba.njit(cache=True)
def _jitter(
    rows: NDArray, columns: NDArray, depth: NDArray, instance: NDArray, facet: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return depth, instance and facet of where each pixel looks, shifted by so many px."""
    height, width = rows.shape
    z, owner, piece = np.empty_like(depth), np.empty_like(instance), np.empty_like(facet)
    for v in range(height):
        for u in range(width):
            row = min(max(int(v + 1000.5 + rows[v, u]) - 1000, 0), height - 1)  # int() rounds towards 0
            column = min(max(int(u + 1000.5 + columns[v, u]) - 1000, 0), width - 1)
            z[v, u], owner[v, u], piece[v, u] = depth[row, column], instance[row, column], facet[row, column]
    return z, owner, piece


@numba.njit(cache=True)
def _shadow(depth: NDArray, reach: float, lost: NDArray) -> None:
    """Mark pixels that a second eye to the right does not see; `reach` is focal length times baseline, px m.

    Each row is carried to the second eye, where the nearest surface covers what lies within a pixel behind it.
    """
    height, width = depth.shape
    nearest = np.inf
    for v in range(height):
        for u in range(width):
            if depth[v, u] > 0:
                nearest = min(nearest, depth[v, u])
    if nearest == np.inf:
        return
    margin = int(reach / nearest) + 2
    seen = np.empty(width + margin + 1)
    for v in range(height):
        seen[:] = 0.0
        for u in range(width):
            if depth[v, u] > 0:
                disparity = reach / depth[v, u]
                k = int(u - disparity + margin)
                seen[k], seen[k + 1] = max(seen[k], disparity), max(seen[k + 1], disparity)
        for u in range(width):
            if depth[v, u] > 0:
                disparity = reach / depth[v, u]
                lost[v, u] |= seen[int(u - disparity + margin + 0.5)] > disparity + 1


@numba.njit(cache=True)
def _punch(lost: NDArray, holes: NDArray, largest: float) -> None:
    """Mark round holes: (row, column, radius) as shares."""
    height, width = lost.shape
    for hole in holes:
        row, column, radius = hole[0] * height, hole[1] * width, 1 + hole[2] * (largest - 1)
        for v in range(max(int(row - radius), 0), min(int(row + radius) + 2, height)):
            for u in range(max(int(column - radius), 0), min(int(column + radius) + 2, width)):
                lost[v, u] |= (v - row) ** 2 + (u - column) ** 2 < radius**2


@numba.njit(cache=True)
def _spoil(
    depth: NDArray,
    facet: NDArray,
    facets: NDArray,
    intrinsics: NDArray,
    lost: NDArray,
    luck: NDArray,
    white: NDArray,
    slow: NDArray,
    errors: tuple[float, float, float, float, float],
    losses: tuple[float, float, float, float, float],
) -> NDArray:
    sigma, proportional, clip, step, quantum = errors
    dropout, edge, edge_dropout, flying, grazing = losses
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    measured = np.zeros(depth.shape, np.float32)
    for v in range(height):
        for u in range(width):
            z, chance = float(depth[v, u]), luck[0, v, u] / 65536
            if z <= 0 or lost[v, u] or chance < dropout:
                continue
            if grazing > 1e-9:
                a, b, n = (u - cx) / fx, (v - cy) / fy, facets[facet[v, u]]
                cosine = abs(n[0] * a + n[1] * b + n[2]) / np.sqrt(a * a + b * b + 1)
                if luck[1, v, u] / 65536 * grazing > cosine:
                    continue
            near = far = z
            ends = False  # what is out of range is beyond an edge, too
            for i, j in ((v - 1, u), (v + 1, u), (v, u - 1), (v, u + 1)):
                if 0 <= i < height and 0 <= j < width:
                    other = float(depth[i, j])
                    ends |= other <= 0
                    near, far = min(near, other if other > 0 else z), max(far, other)
            if far - near > edge or ends:
                if chance < edge_dropout:
                    continue
                share = (chance - edge_dropout) / max(1 - edge_dropout, 1e-9)
                if share < flying:
                    z = near + share / flying * (far - near)
            error = (sigma + proportional * z) * white[v, u]
            if slow.size > 1:
                error += z * z * slow[v, u]
            z += min(max(error, -clip), clip)
            if step > 0 and z > 0:
                z = 1 / (max(round(1 / (z * step)), 1) * step)
            if quantum > 0:
                z = round(z / quantum) * quantum
            measured[v, u] = z
    return measured
