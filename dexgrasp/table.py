"""The plane on which a scene stands, found in its cloud: what the camera cannot see of it is solid all the same."""

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.geometry import pose
from dexgrasp.seeds import torch_stream

TRIALS = 256
SAMPLE = 2048


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
    points, normals = sample.split(3, dim=1)
    triples = points[torch.randint(len(points), (TRIALS, 3), generator=sampler)]
    normal = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normal = torch.nn.functional.normalize(normal, dim=1)
    offset = -(normal * triples[:, 0]).sum(1)
    normal, offset = torch.where(offset[:, None] < 0, -normal, normal), offset.abs()  # the camera is above
    height = points @ normal.T + offset
    on = (height.abs() < tolerance) & (normals @ normal.T > 0.9)
    support = on.double().mean(0)
    proper = (height < -0.01).double().mean(0) <= below
    proper &= (height > 0.01).double().mean(0) >= above
    support = torch.where(proper, support, torch.zeros_like(support))
    best = int(support.argmax())
    if support[best] < share:
        return None
    return _refined(rows, normal[best], offset[best], tolerance)


def _refined(
    rows: Float[Tensor, "N 6"], up: Float[Tensor, "3"], offset: Tensor, tolerance: float, rounds: int = 4
) -> Float[Tensor, "4 4"]:
    """Fit the plane to all points near it, in a band that narrows down to the noise: feet of objects tilt it."""
    points, normals = rows.split(3, dim=1)
    band = tolerance
    for _ in range(rounds):
        height = points @ up + offset
        near = points[(height.abs() < band) & (normals @ up > 0.9)]
        if len(near) < 3:
            break
        centre = near.mean(0)
        axis = torch.linalg.svd(near - centre, full_matrices=False).Vh[2]
        up = axis if axis @ up > 0 else -axis
        offset = -(up @ centre)
        spread = (near @ up + offset).abs().median()
        band = min(tolerance, max(0.002, 3 * float(spread)))
    return _frame(up, -offset * up)


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
