"""How deep observed points lie in a hand."""

import numpy as np
from numba import njit

from dexgrasp.borrow import borrowed
from dexgrasp.hand_body import HandBody, carry, place_links


@njit(cache=True)
def cloud_depths(body: HandBody, cloud: np.ndarray, bases: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return (N,) the depth of the deepest point (P, 3) in each hand, 0 for none (m); all in one frame."""
    body, cloud, bases, joints = borrowed(body), borrowed(cloud), borrowed(bases), borrowed(joints)
    found = np.zeros(len(bases))
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    parts = len(body.part_links)
    centers, squares = np.empty((parts, 3)), body.part_balls[:, 3] ** 2
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        middle, around = np.zeros(3), 0.0
        for p in range(parts):
            x, y, z = carry(poses, body.part_links[p], body.part_balls, p)
            centers[p, 0], centers[p, 1], centers[p, 2] = x, y, z
            middle += centers[p] / parts
        for p in range(parts):
            around = max(around, np.sqrt(((centers[p] - middle) ** 2).sum()) + body.part_balls[p, 3])
        around *= around
        m0, m1, m2 = middle
        best = 0.0
        for k in range(len(cloud)):
            x, y, z = cloud[k, 0], cloud[k, 1], cloud[k, 2]
            if (x - m0) ** 2 + (y - m1) ** 2 + (z - m2) ** 2 > around:
                continue
            for p in range(parts):
                dx, dy, dz = x - centers[p, 0], y - centers[p, 1], z - centers[p, 2]
                if dx * dx + dy * dy + dz * dz > squares[p]:
                    continue
                pose = poses[body.part_links[p]]
                ux, uy, uz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
                lx = pose[0, 0] * ux + pose[1, 0] * uy + pose[2, 0] * uz
                ly = pose[0, 1] * ux + pose[1, 1] * uy + pose[2, 1] * uz
                lz = pose[0, 2] * ux + pose[1, 2] * uy + pose[2, 2] * uz
                depth = np.inf
                for s in range(body.parts[p], body.parts[p + 1]):
                    side = body.planes[s]
                    depth = min(depth, side[3] - side[0] * lx - side[1] * ly - side[2] * lz)
                    if depth <= best:
                        break
                best = max(best, depth)
        found[i] = best
    return found
