"""Which points of a measured scene become a cloud, found without object masks.

A robot knows its workspace (a box in its own frame) and can find the dominant plane; so clouds are cropped to the box,
and the plane is thinned so that most points lie on things.
"""

from dataclasses import dataclass, replace

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt


@dataclass(frozen=True)
class Framing:
    """Which part of a depth image becomes a cloud."""

    points: int = 8192
    low: tuple[float, float, float] = (-0.2, -0.2, -0.02)
    """Corner of the workspace, world frame, m."""
    high: tuple[float, float, float] = (0.2, 0.2, 0.35)
    plane_share: float = 0.25
    """Largest share of the points that may lie on the dominant plane; 1 keeps every point equally likely."""
    plane_distance: float = 0.004
    """Distance from the plane up to which a point belongs to it, m."""
    plane_margin: float = 0.03
    """Points of a table that are farther than this from all that stands on it are left out, m; inf keeps them."""
    voxel: float = 0.0
    """Of points that share a cube of this side one is kept, m; 0 keeps all. For clouds of several views."""


def downsample(
    points: Float[np.ndarray, "P 3"], framing: Framing, generator: np.random.Generator
) -> Int[np.ndarray, "N"]:
    """Return the indices of `framing.points` random points, at most `plane_share` of them on the dominant plane.

    Of a table, only the surroundings of what stands on it are kept. Purely geometric (points in the camera frame, m):
    meant for prediction on foreign clouds as well as for training data.
    """
    if framing.voxel > 0:
        cells = np.floor(points / framing.voxel).astype(np.int64) - int(np.floor(points.min() / framing.voxel))
        spans = cells.max(axis=0) + 1
        order = generator.permutation(len(points))  # which of a cube's points stays is left to chance
        _, first = np.unique(
            ((cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2])[order], return_index=True
        )
        kept = np.sort(order[first])
        return kept[downsample(points[kept], replace(framing, voxel=0.0), generator)]
    count, total = framing.points, len(points)
    if total <= count:
        return generator.permutation(np.concatenate([np.arange(total), generator.integers(total, size=count - total)]))
    if framing.plane_share >= 1:
        return generator.choice(total, count, replace=False)
    heights, basis = dominant_plane(points, framing.plane_distance, generator)
    on_plane = np.abs(heights) < framing.plane_distance
    wanted = ~on_plane | _near_standing(basis, heights, framing)
    if wanted.sum() < count:
        wanted[:] = True
    plane, rest = np.flatnonzero(on_plane & wanted), np.flatnonzero(~on_plane)
    fair = round(count * len(plane) / (len(plane) + len(rest)))
    share = max(min(fair, round(framing.plane_share * count)), count - len(rest))
    return generator.permutation(
        np.concatenate(
            [generator.choice(plane, share, replace=False), generator.choice(rest, count - share, replace=False)]
        )
    )


def dominant_plane(
    points: Float[np.ndarray, "P 3"], distance: float, generator: np.random.Generator, trials: int = 128
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    """Find the plane that holds most points within `distance` (RANSAC); points are in the camera frame, m.

    Return signed heights above it, positive on the camera's side, and coordinates within it.
    """
    sample = points[generator.choice(len(points), min(len(points), 1024), replace=False)].astype(np.float64)
    corners = sample[generator.integers(len(sample), size=(trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None] + 1e-30
    offsets = (normals * corners[:, 0]).sum(axis=1)
    inliers = (np.abs(sample @ normals.T - offsets) < distance) & (length > 1e-6)
    best = inliers.sum(axis=0).argmax()
    # Once more by least squares: three noisy points tilt the plane.
    near = sample[inliers[:, best]]
    middle = near.mean(axis=0)
    axes = np.linalg.svd(near - middle, full_matrices=False)[2]
    if middle @ axes[2] > 0:
        axes[2] *= -1
    local = (points - middle) @ axes.T
    return local[:, 2], local[:, :2]


def _near_standing(
    places: Float[np.ndarray, "P 2"], heights: Float[np.ndarray, "P"], framing: Framing
) -> Bool[np.ndarray, "P"]:
    """Tell which points of a table have something standing on it within `plane_margin`, by a grid of 5 mm.

    All of them where the plane is no table: where it is the top or a side of something, more lies behind it.
    """
    thick = 2 * framing.plane_distance
    if not np.isfinite(framing.plane_margin) or (heights < -thick).mean() > 0.03:
        return np.ones(len(heights), dtype=bool)
    cells, shape = _cells(places, 0.005)
    free = np.ones(shape, dtype=bool)
    free.ravel()[cells[heights > thick]] = False
    if free.all():
        return np.ones(len(heights), dtype=bool)
    return (distance_transform_edt(free).ravel() * 0.005 <= framing.plane_margin)[cells]


@numba.njit(cache=True)
def _cells(places: NDArray, step: float) -> tuple[NDArray, tuple[int, int]]:
    """Return in which square of a grid (row by row) each place lies, and the size of the grid."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(places)):
        for k in range(2):
            low[k], high[k] = min(low[k], places[i, k]), max(high[k], places[i, k])
    rows, columns = int((high[0] - low[0]) / step) + 1, int((high[1] - low[1]) / step) + 1
    cells = np.empty(len(places), np.int64)
    for i in range(len(places)):
        cells[i] = int((places[i, 0] - low[0]) / step) * columns + int((places[i, 1] - low[1]) / step)
    return cells, (rows, columns)
