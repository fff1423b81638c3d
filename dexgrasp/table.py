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
