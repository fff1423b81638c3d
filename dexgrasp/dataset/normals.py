"""Surface normals as an observer has them: planes fitted to the observed points, turned to the camera.

Both ways take the neighbours within one radius, so that a network trained on normals of depth images may be given
normals of loose clouds. Fewer than 3 points give the direction to the camera.
"""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.cells import BITS, Cells, find_cell, make_cells

FEWEST = 10
"""Points of a loose cloud that are used however far they are: where a cloud is thin, one radius holds too few."""
SPARSE, WIDER = 10, 1.5
"""Where cells of one radius hold fewer points than this, so much larger ones are looked through."""
WIDENINGS = 2
"""Cells are doubled so often for points of which those about them hold too few, before a tree is built."""
RADIUS = 0.010
"""Neighbourhood (m): about 2 deg of noise for 1 mm of depth noise at 1 mm a pixel, and still inside a 2 cm part."""


def estimate_normals(
    points: Float[Tensor, "N 3"],
    viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0),
    k: int = 40,
    radius: float = RADIUS,
    at: Int[np.ndarray, "M"] | None = None,
) -> Float[Tensor, "N 3"]:
    """Return unit normals towards `viewpoint` from the `k` nearest points within `radius`, or the `FEWEST` nearest.

    Positions, radius and viewpoint are in metres and in one frame; the order of points does not matter. Estimate
    before thinning a cloud: the denser it is, the better the normals. With `at`, only those rows' normals, (M, 3),
    still from all points.
    """
    cloud = points.detach().cpu().double().numpy()
    eye = np.asarray(viewpoint, dtype=np.float64)
    if len(cloud) == 0:
        return torch.zeros_like(points)
    k = max(min(k, len(cloud)), 2)
    rows = np.arange(len(cloud)) if at is None else np.asarray(at, dtype=np.int64)
    cells = make_cells(cloud, radius)
    if cells.occupied * SPARSE > len(cloud):
        cells = make_cells(cloud, WIDER * radius)
    wanted = np.zeros(len(cloud), np.bool_)
    wanted[rows] = True
    normals, lonely = _fit_near(cells, wanted, k, min(FEWEST, k), radius, eye)
    for _ in range(WIDENINGS):
        if len(lonely) == 0:
            break
        cells = make_cells(cloud, 2 * cells.side)
        wanted[:] = False
        wanted[lonely] = True
        more, left = _fit_near(cells, wanted, k, min(FEWEST, k), radius, eye)
        normals[lonely], lonely = more[lonely], left
    if len(lonely):
        neighbours = cKDTree(cloud).query(cloud[lonely], k=min(FEWEST, k))[1]
        normals[lonely] = _fit_neighbours(cloud, lonely, neighbours, eye)
    return torch.from_numpy(normals[rows]).to(points)


def depth_normals(
    depth: Float[np.ndarray, "H W"],
    pixels: Int[np.ndarray, "N"],
    focal: tuple[float, float],
    centre: tuple[float, float],
    radius: float = RADIUS,
) -> Float[np.ndarray, "N 3"]:
    """Return unit normals towards the camera at some pixels (row * W + column) of a depth image.

    `depth` is z in metres, 0 or less where nothing was measured; `focal` and `centre` are in pixels. Neighbours are
    the measured pixels within `radius` (m), which stops at depth edges.
    """
    arrays = depth.astype(np.float64), pixels.astype(np.int64)
    return _fit_pixels(*arrays, focal[0], focal[1], centre[0], centre[1], radius)


@numba.njit(cache=True)
def _fit_near(
    cells: Cells, wanted: NDArray, most: int, fewest: int, radius: float, eye: NDArray
) -> tuple[NDArray, NDArray]:
    """Fit the `most` nearest points within the radius, or the `fewest` nearest where there are fewer.

    Return the normals (N, 3) of the `wanted` points, and those of which even the surrounding cells hold too few.
    """
    cells, wanted = borrowed(cells), borrowed(wanted)
    keys, order, low, side = cells.keys, cells.order, cells.low, cells.side
    px, py, pz = cells.points
    normals, lonely, alone = np.zeros((len(px), 3)), np.empty(len(px), np.int64), 0
    around, near, index = np.empty((3, len(px))), np.empty(len(px)), np.empty(len(px), np.int64)
    qx, qy, qz = around
    sums, least, count, known = np.empty(9), np.empty(fewest), 0, -1
    for m in range(len(px)):
        if not wanted[order[m]]:
            continue
        x, y, z = px[m], py[m], pz[m]
        i, j, k = int((x - low[0]) / side) + 1, int((y - low[1]) / side) + 1, int((z - low[2]) / side) + 1
        own = (i << 2 * BITS) | (j << BITS) | k
        if own != known:  # points of one cell follow each other: they have the same around them
            known, count = own, 0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    for c in range(k - 1, k + 2):
                        key = (a << 2 * BITS) | (b << BITS) | c
                        slot = find_cell(keys, key)
                        if keys[slot] == key:
                            for n in range(cells.starts[slot], cells.stops[slot]):
                                qx[count], qy[count], qz[count] = px[n], py[n], pz[n]
                                count += 1
        limit, inside = radius * radius, 0
        for n in range(count):
            u, v, w = qx[n] - x, qy[n] - y, qz[n] - z
            near[n] = u * u + v * v + w * w
        for n in range(count):
            inside += near[n] <= limit
        if inside > most:
            limit = min(limit, np.partition(near[:count], most - 1)[most - 1])
        elif inside < fewest:
            limit = _smallest(near, count, least) if count >= fewest else np.inf
            if limit > side * side:  # something nearer may lie in other cells
                lonely[alone] = order[m]
                alone += 1
                continue
        taken = 0
        for n in range(count):
            index[taken] = n
            taken += near[n] <= limit
        sums[:] = 0.0
        for n in range(taken):
            _add(sums, qx[index[n]] - x, qy[index[n]] - y, qz[index[n]] - z)
        _plane(sums, taken, eye[0] - x, eye[1] - y, eye[2] - z, normals[order[m]])
    return normals, lonely[:alone]


@numba.njit(cache=True)
def _smallest(values: NDArray, count: int, least: NDArray) -> float:
    """Return the largest of the smallest of the first `count` values, as many as `least` has room for."""
    least[:] = np.inf
    for n in range(count):
        value, place = values[n], len(least) - 1
        if value >= least[place]:
            continue
        while place > 0 and least[place - 1] > value:
            least[place] = least[place - 1]
            place -= 1
        least[place] = value
    return float(least[-1])


@numba.njit(cache=True)
def _fit_neighbours(cloud: NDArray, rows: NDArray, neighbours: NDArray, eye: NDArray) -> NDArray:
    normals = np.empty((len(rows), 3))
    sums = np.empty(9)
    for m in range(len(rows)):
        i = rows[m]
        sums[:] = 0.0
        count = 0
        for j in neighbours[m]:
            _add(sums, cloud[j, 0] - cloud[i, 0], cloud[j, 1] - cloud[i, 1], cloud[j, 2] - cloud[i, 2])
            count += 1
        _plane(sums, count, eye[0] - cloud[i, 0], eye[1] - cloud[i, 1], eye[2] - cloud[i, 2], normals[m])
    return normals


@numba.njit(cache=True)
def _fit_pixels(depth: NDArray, pixels: NDArray, fx: float, fy: float, cx: float, cy: float, radius: float) -> NDArray:
    height, width = depth.shape
    inverse = 1 / fx
    normals = np.empty((len(pixels), 3))
    sums = np.empty(9)
    for i in range(len(pixels)):
        row, column = pixels[i] // width, pixels[i] % width
        z = depth[row, column]
        x, y = (column - cx) / fx * z, (row - cy) / fy * z
        # About the longest reach in pixels: of a point that is nearer to the camera by the radius.
        reach = math.ceil(radius * max(fx, fy) / max(z - radius, 1e-3))
        count, sx, sy, sz = 0, 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for v in range(max(row - reach, 0), min(row + reach + 1, height)):
            side = int(math.sqrt(reach * reach - (v - row) * (v - row)))
            slope = (v - cy) / fy
            for u in range(max(column - side, 0), min(column + side + 1, width)):
                d = depth[v, u]
                a, b, c = (u - cx) * inverse * d - x, slope * d - y, d - z
                if d > 0 and a * a + b * b + c * c <= radius * radius:
                    count += 1
                    sx, sy, sz = sx + a, sy + b, sz + c
                    xx, xy, xz = xx + a * a, xy + a * b, xz + a * c
                    yy, yz, zz = yy + b * b, yz + b * c, zz + c * c
        sums[:] = sx, sy, sz, xx, xy, xz, yy, yz, zz
        _plane(sums, count, -x, -y, -z, normals[i])
    return normals


@numba.njit(cache=True)
def _add(sums: NDArray, x: float, y: float, z: float) -> None:
    sums[0] += x
    sums[1] += y
    sums[2] += z
    sums[3] += x * x
    sums[4] += x * y
    sums[5] += x * z
    sums[6] += y * y
    sums[7] += y * z
    sums[8] += z * z


@numba.njit(cache=True)
def _plane(sums: NDArray, count: int, ex: float, ey: float, ez: float, normal: NDArray) -> None:
    """Fit a plane to moments about the point; `normal` gets its unit normal on the side of the eye (ex, ey, ez)."""
    length = math.sqrt(ex * ex + ey * ey + ez * ez) + 1e-300
    normal[0], normal[1], normal[2] = ex / length, ey / length, ez / length
    if count < 3:
        return
    mx, my, mz = sums[0] / count, sums[1] / count, sums[2] / count
    xx, xy, xz = sums[3] / count - mx * mx, sums[4] / count - mx * my, sums[5] / count - mx * mz
    yy, yz, zz = sums[6] / count - my * my, sums[7] / count - my * mz, sums[8] / count - mz * mz
    # Smallest eigenvalue in closed form (Smith 1961), then the null space as the longest cross product of two rows.
    mean = (xx + yy + zz) / 3
    spread = (xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * (xy * xy + xz * xz + yz * yz)
    scale = math.sqrt(spread / 6)
    if scale <= 1e-12 * abs(mean):
        return
    a, b, c = (xx - mean) / scale, (yy - mean) / scale, (zz - mean) / scale
    p, q, r = xy / scale, xz / scale, yz / scale
    half = (a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)) / 2
    angle = math.acos(min(1.0, max(-1.0, half))) / 3
    least = 2 * math.cos(angle + 2 * math.pi / 3)
    a, b, c = a - least, b - least, c - least
    best = 0.0
    for k in range(3):
        if k == 0:
            nx, ny, nz = p * r - q * b, q * p - a * r, a * b - p * p
        elif k == 1:
            nx, ny, nz = p * c - q * r, q * q - a * c, a * r - p * q
        else:
            nx, ny, nz = b * c - r * r, r * q - p * c, p * r - b * q
        square = nx * nx + ny * ny + nz * nz
        if square > best:
            best = square
            sign = 1.0 if nx * ex + ny * ey + nz * ez >= 0 else -1.0
            factor = sign / math.sqrt(square)
            normal[0], normal[1], normal[2] = nx * factor, ny * factor, nz * factor
