"""Farthest point sampling and neighbours of a cloud, independent of the order of its points.

The points' device decides how: compiled on the CPU, by `dexgrasp.kernels` on CUDA where Triton is. Each function has a
pure-torch reference of the same result, for tests. Indices lie where the points lie.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp import kernels
from dexgrasp.borrow import borrowed
from dexgrasp.cells import BITS, Cells, bounds, find_cell, make_cells

_BUCKET = 64
"""Points per bucket: below it the tests of the boxes dominate, above it the distances."""
FEW = 256
"""Among so few points, looking at all of them is quicker than a tree."""


def farthest_points(points: Float[Tensor, "N 3"], count: int) -> Int[Tensor, "count"]:
    """Return `count` indices, each the point farthest from all before it (Eldar et al. 1997), exactly.

    The first is the point farthest from the middle of the bounding box; equal distances are decided by x, then y,
    then z. More points than there are repeat the first in that order.
    """
    if kernels.usable(points):
        return kernels.arrange(points[None]).farthest(count)[0]
    xyz = np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float32)
    order = np.argsort(morton(xyz), kind="stable")
    return torch.from_numpy(order[_farthest(xyz[order], count)]).to(points.device)


def farthest_points_reference(points: Float[Tensor, "N 3"], count: int) -> Int[Tensor, "count"]:
    """Return the same as `farthest_points`, in O(N count) torch on the points' device."""
    xyz = points.detach().float()
    rank = torch.from_numpy(np.lexsort(xyz.cpu().numpy().T[::-1])).to(xyz.device)
    xyz = xyz[rank]  # argmax takes the first of equals
    chosen = _squared(xyz - (xyz.amin(0) + xyz.amax(0)) / 2).argmax().reshape(1)
    nearest = torch.full_like(xyz[:, 0], float("inf"))
    for _ in range(count - 1):
        nearest = torch.minimum(nearest, _squared(xyz - xyz[chosen[-1]]))
        chosen = torch.cat([chosen, nearest.argmax().reshape(1)])
    return rank[chosen]


def neighbours(
    points: Float[Tensor, "N 3"], centres: Float[Tensor, "M 3"], count: int, radius: float = float("inf")
) -> Int[Tensor, "M count"]:
    """Return the nearest `count` points within `radius` (m) of each centre, nearest first.

    Where there are fewer, the nearest is repeated (also when it lies outside). Which of equal distances comes first is
    left open on the CPU; on CUDA, x decides, then y, then z.
    """
    if kernels.usable(points):
        return kernels.arrange(points[None]).nearest(centres[None], count, radius)[0]
    cloud, query = (part.detach().cpu().double().numpy() for part in (points, centres))
    if radius == float("inf") and count <= len(cloud) <= FEW:
        return torch.from_numpy(_nearest(np.ascontiguousarray(cloud.T), query, count)).to(points.device)
    if radius == float("inf"):
        index = cKDTree(cloud, balanced_tree=False, compact_nodes=False).query(query, k=range(1, count + 1))[1]
        return torch.from_numpy(np.where(index == len(cloud), index[:, :1], index)).to(points.device)
    index = _in_ball(make_cells(cloud, radius), query, count, radius)
    lonely = index[:, 0] < 0
    if lonely.any():
        index[lonely] = cKDTree(cloud).query(query[lonely])[1][:, None]
    return torch.from_numpy(index).to(points.device)


def neighbours_reference(
    points: Float[Tensor, "N 3"], centres: Float[Tensor, "M 3"], count: int, radius: float = float("inf")
) -> Int[Tensor, "M count"]:
    """Return the same as `neighbours`, in O(N M) torch on the points' device."""
    table = torch.cdist(centres.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
    distance, index = table.topk(min(count, len(points)), dim=1, largest=False)
    index = torch.where(distance < radius, index, index[:, :1])
    return torch.cat([index, index[:, :1].expand(-1, count - index.shape[1])], dim=1)


@njit(cache=True)
def _in_ball(cells: Cells, centres: np.ndarray, count: int, radius: float) -> np.ndarray:
    """Return `neighbours` of centres (M, 3), from the cells about each; -1 where there are none."""
    cells, centres = borrowed(cells), borrowed(centres)
    low, side = cells.low, cells.side
    px, py, pz = cells.points
    index = np.empty((len(centres), count), np.int64)
    near, apart = np.empty(len(px), np.int64), np.empty(len(px))
    best = np.empty(count)
    for m in range(len(centres)):
        x, y, z = centres[m]
        i, j, k = int((x - low[0]) / side) + 1, int((y - low[1]) / side) + 1, int((z - low[2]) / side) + 1
        total, found = 0, 0
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                for c in range(k - 1, k + 2):
                    key = (a << 2 * BITS) | (b << BITS) | c
                    slot = find_cell(cells.keys, key)
                    if cells.keys[slot] != key:
                        continue
                    start = cells.starts[slot]
                    for n in range(cells.stops[slot] - start):
                        u, v, w = px[start + n] - x, py[start + n] - y, pz[start + n] - z
                        near[total + n], apart[total + n] = start + n, u * u + v * v + w * w
                    total += cells.stops[slot] - start
        limit = radius * radius
        for n in range(total):
            d = apart[n]
            if d >= limit:
                continue
            place = min(found, count - 1)
            while place > 0 and best[place - 1] > d:
                best[place], index[m, place] = best[place - 1], index[m, place - 1]
                place -= 1
            best[place], index[m, place] = d, cells.order[near[n]]
            found = min(found + 1, count)
            if found == count:
                limit = best[count - 1]
        index[m, found:] = index[m, 0] if found else -1
    return index


@njit(cache=True)
def _nearest(columns: np.ndarray, centres: np.ndarray, count: int) -> np.ndarray:
    """Return the nearest `count` of points (3, N), nearest first, of each centre (M, 3)."""
    columns, centres = borrowed(columns), borrowed(centres)
    px, py, pz = columns
    index, best, apart = np.empty((len(centres), count), np.int64), np.empty(count), np.empty(len(px))
    for m in range(len(centres)):
        x, y, z = centres[m]
        for n in range(len(px)):
            u, v, w = px[n] - x, py[n] - y, pz[n] - z
            apart[n] = u * u + v * v + w * w
        best[:] = np.inf
        for n in range(len(px)):
            if apart[n] < best[count - 1]:
                place = count - 1
                while place > 0 and best[place - 1] > apart[n]:
                    best[place], index[m, place] = best[place - 1], index[m, place - 1]
                    place -= 1
                best[place], index[m, place] = apart[n], n
    return index


def _squared(vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    x, y, z = vectors.unbind(-1)
    return x * x + y * y + z * z  # the kernel's order of operations, bit by bit


def morton(xyz: np.ndarray) -> np.ndarray:
    """Return the position of each point along a space-filling curve (Morton 1966), 10 bits an axis."""
    low, high = bounds(xyz)
    extent = max(float((high - low).max()), 1e-9)
    cells = ((xyz - low) * np.float32(1023.0 / extent)).astype(np.uint32)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint32(shift))) & np.uint32(mask)
    return cells[:, 0] | (cells[:, 1] << np.uint32(1)) | (cells[:, 2] << np.uint32(2))


@njit(cache=True)
def _before(xyz: np.ndarray, a: int, b: int) -> bool:
    for axis in range(3):
        if xyz[a, axis] != xyz[b, axis]:
            return xyz[a, axis] < xyz[b, axis]
    return False


@njit(cache=True)
def _farthest(xyz: np.ndarray, count: int) -> np.ndarray:
    """Return farthest points of a spatially sorted cloud; buckets of it that a choice cannot reach are skipped.

    The bound is exact: rounding is monotone, so a computed distance to a box never exceeds that to a point in it.
    """
    total = len(xyz)
    buckets = (total + _BUCKET - 1) // _BUCKET
    low = np.empty((3, buckets), np.float32)
    high = np.empty((3, buckets), np.float32)
    nearest = np.full(total, np.inf, np.float32)
    farthest = np.full(buckets, np.inf, np.float32)
    # Distances are not negative: their bits are in their order, and whole numbers are compared many at a time.
    nearest_bits, farthest_bits = nearest.view(np.int32), farthest.view(np.int32)
    best, apart = np.empty(buckets, np.int64), np.empty(buckets, np.float32)
    columns = np.empty((3, total), np.float32)
    for axis in range(3):
        columns[axis] = xyz[:, axis]
        for b in range(buckets):
            part = columns[axis, b * _BUCKET : (b + 1) * _BUCKET]
            low[axis, b], high[axis, b] = part.min(), part.max()
    middle = np.empty(3, np.float32)
    for axis in range(3):
        middle[axis] = (columns[axis].min() + columns[axis].max()) / np.float32(2)
    current, reach = 0, np.float32(-1)
    for i in range(total):
        dx, dy, dz = xyz[i, 0] - middle[0], xyz[i, 1] - middle[1], xyz[i, 2] - middle[2]
        d = dx * dx + dy * dy + dz * dz
        if d > reach or (d == reach and _before(xyz, i, current)):
            reach, current = d, i

    chosen = np.empty(count, np.int64)
    zero = np.float32(0)
    for step in range(count):
        chosen[step] = current
        x, y, z = xyz[current, 0], xyz[current, 1], xyz[current, 2]
        for b in range(buckets):
            dx = max(low[0, b] - x, x - high[0, b], zero)
            dy = max(low[1, b] - y, y - high[1, b], zero)
            dz = max(low[2, b] - z, z - high[2, b], zero)
            apart[b] = dx * dx + dy * dy + dz * dz
        for b in range(buckets):
            if apart[b] < farthest[b]:
                start, stop = b * _BUCKET, min((b + 1) * _BUCKET, total)
                for i in range(start, stop):
                    ex, ey, ez = columns[0, i] - x, columns[1, i] - y, columns[2, i] - z
                    nearest[i] = min(nearest[i], ex * ex + ey * ey + ez * ez)
                most = nearest_bits[start:stop].max()
                where = -1
                for i in range(start, stop):
                    if nearest_bits[i] == most and (where < 0 or _before(xyz, i, where)):
                        where = i
                farthest_bits[b], best[b] = most, where
        most = farthest_bits.max()
        current = -1
        for b in range(buckets):
            if farthest_bits[b] == most and (current < 0 or _before(xyz, best[b], current)):
                current = best[b]
    return chosen
