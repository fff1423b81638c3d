"""Hands above many tables at once: as many as an object has resting poses."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.collision import HandShape, as_arrays
from dexgrasp.hand_body import HandBody, carry, place_links


def headroom(
    shape: HandShape,
    tables: Float[Tensor, "K 4"],
    pose: Float[Tensor, "N 4 4"],
    joints: Float[Tensor, "N J"],
    least: float,
) -> Bool[Tensor, "N K"]:
    """Tell which hands keep at least `least` (m) above which tables.

    A table (a, b), a unit, gives heights a . x + b; poses frame_T_base share its frame, e.g. that of an object, for
    which the third row of each resting pose world_T_object is a table.
    """
    planes = np.ascontiguousarray(tables.detach().cpu().double().numpy())
    return torch.from_numpy(_headroom(shape.body, shape.corners, planes, *as_arrays(pose, joints), least))


@njit(cache=True)
def _headroom(
    body: HandBody, corners: np.ndarray, planes: np.ndarray, bases: np.ndarray, joints: np.ndarray, least: float
) -> np.ndarray:
    free = np.ones((len(bases), len(planes)), np.bool_)
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        for p in range(len(body.part_links)):
            link = body.part_links[p]
            x, y, z = carry(poses, link, body.part_balls, p)
            for k in range(len(planes)):
                if not free[i, k]:
                    continue
                a, b, c = planes[k, 0], planes[k, 1], planes[k, 2]
                middle = a * x + b * y + c * z + planes[k, 3]
                if middle - body.part_balls[p, 3] >= least:
                    continue
                if middle < least:
                    free[i, k] = False
                    continue
                # The table in the link's frame.
                pose = poses[link]
                u = a * pose[0, 0] + b * pose[1, 0] + c * pose[2, 0]
                v = a * pose[0, 1] + b * pose[1, 1] + c * pose[2, 1]
                w = a * pose[0, 2] + b * pose[1, 2] + c * pose[2, 2]
                t = a * pose[0, 3] + b * pose[1, 3] + c * pose[2, 3] + planes[k, 3]
                for j in range(corners[p], corners[p + 1]):
                    corner = body.vertices[j]
                    if u * corner[0] + v * corner[1] + w * corner[2] + t < least:
                        free[i, k] = False
                        break
    return free
