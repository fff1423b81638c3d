"""The plane on which a scene stands, found in its cloud: what the camera cannot see of it is solid all the same."""

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from dexgrasp.geometry import pose
from dexgrasp.seeds import torch_stream

TRIALS = 256
SAMPLE = 2048
PIECE = 256
"""Points that are looked at before a plane is given up."""


def find_table(
    cloud: Float[Tensor, "N 6"],
    seed: int = 0,
    *,
    tolerance: float = 0.006,
    share: float = 0.12,
    below: float = 0.02,
    above: float = 0.02,
) -> Float[Tensor, "4 4"] | None:
    """Return table_T_camera (z up, surface at z = 0, float64), or None where no support plane is seen.

    RANSAC (Fischler & Bolles 1981) over triples of points; a support plane holds at least `share` of the points
    within `tolerance` (m) with agreeing normals, has at most `below` of them further than 1 cm behind it, as seen from
    the camera, and at least `above` of them further than 1 cm in front of it. A box's front has no points in front,
    its top has points behind.
    """
    sampler = torch_stream(seed, "table")
    rows = cloud.double()
    sample = rows[torch.randperm(len(rows), generator=sampler)[:SAMPLE]]
    points = sample[:, :3]
    triples = points[torch.randint(len(points), (TRIALS, 3), generator=sampler)]
    normal = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    offset = -(normal * triples[:, 0]).sum(1)
    normal, offset = torch.where(offset[:, None] < 0, -normal, normal), offset.abs()  # the camera is above
    columns = np.ascontiguousarray(sample.float().numpy().T)
    counts = _count(columns, torch.column_stack([normal, offset]).float().numpy(), tolerance, below)
    on, behind, before = torch.from_numpy(counts / len(sample)).T
    support = torch.where((behind <= below) & (before >= above), on, 0.0)
    best = int(support.argmax())
    if support[best] < share:
        return None
    return _refined(rows, normal[best], offset[best], tolerance)


@njit(cache=True)
def _count(rows: np.ndarray, planes: np.ndarray, tolerance: float, below: float) -> np.ndarray:
    """Return (K, 3): points on each plane with agreeing normals, and more than 1 cm behind and before it.

    `rows` (6, P) are positions and normals, `planes` (K, 4) normal and offset; float32. A plane that has more than a
    share `below` behind it is not counted to the end.
    """
    counts = np.empty((len(planes), 3))
    px, py, pz, nx, ny, nz = rows
    near, apart = np.float32(tolerance), np.float32(0.01)
    for k in range(len(planes)):
        a, b, c, d = planes[k]
        on, behind, before = np.int32(0), np.int32(0), np.int32(0)
        for start in range(0, len(px), PIECE):
            for i in range(start, min(start + PIECE, len(px))):
                height = a * px[i] + b * py[i] + c * pz[i] + d
                along = a * nx[i] + b * ny[i] + c * nz[i]
                on += np.int32((abs(height) < near) & (along > np.float32(0.9)))
                behind += np.int32(height < -apart)
                before += np.int32(height > apart)
            if behind / len(px) > below:
                break
        counts[k, 0], counts[k, 1], counts[k, 2] = on, behind, before
    return counts


def _refined(
    rows: Float[Tensor, "N 6"], up: Float[Tensor, "3"], offset: Tensor, tolerance: float, rounds: int = 4
) -> Float[Tensor, "4 4"]:
    """Fit the plane to all points near it, in a band that narrows down to the noise: feet of objects tilt it."""
    plane = np.append(up.numpy(), float(offset))
    _narrow(rows.contiguous().numpy(), plane, tolerance, rounds)
    found = torch.from_numpy(plane)
    return _frame(found[:3], -found[3] * found[:3])


@njit(cache=True)
def _narrow(rows: np.ndarray, plane: np.ndarray, tolerance: float, rounds: int) -> None:
    """Fit `plane`, normal and offset, in place."""
    band, near, apart = tolerance, np.empty(len(rows), np.int64), np.empty(len(rows))
    spread, sums = np.empty((3, 3)), np.empty(9)
    for _ in range(rounds):
        a, b, c, d = plane
        count, sums[:] = 0, 0.0
        for i in range(len(rows)):
            x, y, z = rows[i, 0], rows[i, 1], rows[i, 2]
            if abs(a * x + b * y + c * z + d) < band and a * rows[i, 3] + b * rows[i, 4] + c * rows[i, 5] > 0.9:
                near[count] = i
                count += 1
                x, y, z = x + d * a, y + d * b, z + d * c  # about a point of the plane: little cancels
                sums[0], sums[1], sums[2] = sums[0] + x, sums[1] + y, sums[2] + z
                sums[3], sums[4], sums[5] = sums[3] + x * x, sums[4] + x * y, sums[5] + x * z
                sums[6], sums[7], sums[8] = sums[6] + y * y, sums[7] + y * z, sums[8] + z * z
        if count < 3:
            break
        x, y, z = sums[0] / count, sums[1] / count, sums[2] / count
        spread[0, 0], spread[0, 1], spread[0, 2] = (
            sums[3] - count * x * x,
            sums[4] - count * x * y,
            sums[5] - count * x * z,
        )
        spread[1, 1], spread[1, 2], spread[2, 2] = (
            sums[6] - count * y * y,
            sums[7] - count * y * z,
            sums[8] - count * z * z,
        )
        spread[1, 0], spread[2, 0], spread[2, 1] = spread[0, 1], spread[0, 2], spread[1, 2]
        axis = np.linalg.eigh(spread)[1][:, 0]
        sign = 1.0 if axis[0] * a + axis[1] * b + axis[2] * c > 0 else -1.0
        x, y, z = x - d * a, y - d * b, z - d * c
        a, b, c = sign * axis[0], sign * axis[1], sign * axis[2]
        d = -(a * x + b * y + c * z)
        plane[0], plane[1], plane[2], plane[3] = a, b, c, d
        for n in range(count):
            i = near[n]
            apart[n] = abs(a * rows[i, 0] + b * rows[i, 1] + c * rows[i, 2] + d)
        band = min(tolerance, max(0.002, 3 * np.median(apart[:count])))


def _frame(up: Float[Tensor, "3"], origin: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    axis = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(axis, up), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(up, x), up])
    return pose(rotation, -rotation @ origin)


def find_tabletop(
    cloud: Float[Tensor, "N 6"],
    seed: int = 0,
    up: Float[Tensor, "3"] | None = None,
    tolerance: float = 0.008,
) -> Float[Tensor, "4 4"] | None:
    """Return table_T_camera as `find_table` does, of a whole room's cloud, or None.

    Floor, walls and boxes are planes too. Of the largest planes, one after the other (RANSAC), the first is taken on
    which something low stands and which hides what is behind it: a box's top carries nothing, a floor nothing that
    a hand could take beside a table, and no camera sees through a table. `up` is the direction against gravity in the
    camera frame, to which a table is square; where it is not known, the camera is taken not to hang upside down.
    """
    rows, left = cloud.double(), torch.arange(len(cloud))
    sampler = torch_stream(seed, "tabletop")
    for _ in range(PLANES):
        sample = rows[left[torch.randperm(len(left), generator=sampler)[:SAMPLE]]]
        if len(sample) < 3:
            return None
        points, normals = sample.split(3, dim=1)
        triples = points[torch.randint(len(points), (TRIALS, 3), generator=sampler)]
        normal = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
        normal = torch.nn.functional.normalize(normal, dim=1)
        offset = -(normal * triples[:, 0]).sum(1)
        normal, offset = torch.where(offset[:, None] < 0, -normal, normal), offset.abs()
        on = ((points @ normal.T + offset).abs() < tolerance) & (normals @ normal.T > 0.8)
        best = int(on.sum(0).argmax())
        if int(on[:, best].sum()) * len(left) < LEAST * len(sample) * len(rows):
            return None
        frame = _refined(rows[left], normal[best], offset[best], tolerance)
        level = frame[2, 1] < 0.3 if up is None else frame[2, :3] @ up.to(frame) > 0.94
        if level and _carries(rows[:, :3], frame):
            return frame
        height = rows[left, :3] @ frame[2, :3] + frame[2, 3]
        left = left[height.abs() > tolerance]
    return None


PLANES = 6
LEAST = 0.03
"""Smallest share of all points that a table holds."""
SMALLEST = 0.15
"""Least that must be seen of a table along and across, m."""
STEP = 0.02
"""Side of the squares of a table of which is asked whether something was seen there, m."""


def _carries(points: Float[Tensor, "N 3"], table_T_camera: Float[Tensor, "4 4"]) -> bool:
    """Tell whether something between 1.5 and 40 cm stands on a plane, and nothing is seen through it."""
    local = points @ table_T_camera[:3, :3].T + table_T_camera[:3, 3]
    eye = table_T_camera[:3, 3]
    on = local[local[:, 2].abs() < 0.01]
    if len(on) < 10 or eye[2] <= 0:
        return False
    low = on[:, :2].min(0).values
    size = (((on[:, :2].max(0).values - low) / STEP).long() + 1).tolist()
    if min(size) * STEP < SMALLEST:
        return False
    seen = torch.zeros(size, dtype=torch.bool)
    cells = ((on[:, :2] - low) / STEP).long()
    seen[cells[:, 0], cells[:, 1]] = True

    def covered(places: Float[Tensor, "M 2"]) -> Tensor:
        at = ((places - low) / STEP).floor().long()
        inside = ((at >= 0) & (at < torch.tensor(size))).all(1)
        at = torch.where(inside[:, None], at, 0)
        return inside & seen[at[:, 0], at[:, 1]]

    standing = local[(local[:, 2] > 0.015) & (local[:, 2] < 0.4)]
    inside = ((standing[:, :2] >= low) & (standing[:, :2] <= low + STEP * torch.tensor(size))).all(1)
    below = local[local[:, 2] < -0.02]
    rays = eye + (below - eye) * (eye[2] / (eye[2] - below[:, 2]))[:, None]
    through = int(covered(rays[:, :2]).sum())
    return int(inside.sum()) >= 0.005 * len(points) and through <= 0.02 * len(points)
