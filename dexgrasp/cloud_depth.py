"""How deep observed points lie in a hand."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.hand_body import HandBody, carry, place_links
from dexgrasp.sampling import morton

BLOCK = 32
"""Points that are passed over together."""


class Blocks(NamedTuple):
    """P points in an order in which neighbours follow each other, and a ball about every `BLOCK` of them. Metres."""

    columns: np.ndarray
    """(3, P)."""
    balls: np.ndarray
    """(B, 4) centre and radius."""


def in_blocks(points: Float[Tensor, "P 3"]) -> Blocks:
    """Sort points for `cloud_depths`."""
    xyz = np.ascontiguousarray(points.detach().cpu().double().numpy())
    if len(xyz) == 0:
        return Blocks(np.empty((3, 0)), np.empty((0, 4)))
    xyz = xyz[np.argsort(morton(xyz.astype(np.float32)), kind="stable")]
    starts = np.arange(0, len(xyz), BLOCK)
    low, high = np.minimum.reduceat(xyz, starts), np.maximum.reduceat(xyz, starts)
    radius = np.linalg.norm(high - low, axis=1) / 2 + 1e-9
    return Blocks(np.ascontiguousarray(xyz.T), np.column_stack([(low + high) / 2, radius]))


@njit(cache=True)
def cloud_depths(body: HandBody, blocks: Blocks, bases: np.ndarray, joints: np.ndarray, enough: float) -> np.ndarray:
    """Return (N,) the depth of the deepest point in each hand, 0 for none (m); beyond `enough`, any such value."""
    body, blocks, bases, joints = borrowed(body), borrowed(blocks), borrowed(bases), borrowed(joints)
    found = np.zeros(len(bases))
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    columns, balls, parts = blocks.columns, blocks.balls, len(body.part_links)
    centers, near = np.empty((parts, 3)), np.empty(len(balls), np.int64)
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        mx, my, mz, around = 0.0, 0.0, 0.0, 0.0
        for p in range(parts):
            x, y, z = carry(poses, body.part_links[p], body.part_balls, p)
            centers[p, 0], centers[p, 1], centers[p, 2] = x, y, z
            mx, my, mz = mx + x / parts, my + y / parts, mz + z / parts
        for p in range(parts):
            dx, dy, dz = centers[p, 0] - mx, centers[p, 1] - my, centers[p, 2] - mz
            around = max(around, np.sqrt(dx * dx + dy * dy + dz * dz) + body.part_balls[p, 3])
        count = 0
        for b in range(len(balls)):
            dx, dy, dz = balls[b, 0] - mx, balls[b, 1] - my, balls[b, 2] - mz
            reach = balls[b, 3] + around
            if dx * dx + dy * dy + dz * dz <= reach * reach:
                near[count] = b
                count += 1
        best = 0.0
        for p in range(parts):
            if best > enough:
                break
            cx, cy, cz, radius = centers[p, 0], centers[p, 1], centers[p, 2], body.part_balls[p, 3]
            pose = poses[body.part_links[p]]
            for n in range(count):
                b = near[n]
                dx, dy, dz = balls[b, 0] - cx, balls[b, 1] - cy, balls[b, 2] - cz
                reach = balls[b, 3] + radius
                if dx * dx + dy * dy + dz * dz > reach * reach:
                    continue
                for k in range(b * BLOCK, min((b + 1) * BLOCK, columns.shape[1])):
                    x, y, z = columns[0, k], columns[1, k], columns[2, k]
                    dx, dy, dz = x - cx, y - cy, z - cz
                    if dx * dx + dy * dy + dz * dz > radius * radius:
                        continue
                    ux, uy, uz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
                    lx = pose[0, 0] * ux + pose[1, 0] * uy + pose[2, 0] * uz
                    ly = pose[0, 1] * ux + pose[1, 1] * uy + pose[2, 1] * uz
                    lz = pose[0, 2] * ux + pose[1, 2] * uy + pose[2, 2] * uz
                    depth = np.inf
                    for s in range(body.parts[p], body.parts[p + 1]):
                        depth = min(
                            depth,
                            body.planes[s, 3]
                            - body.planes[s, 0] * lx
                            - body.planes[s, 1] * ly
                            - body.planes[s, 2] * lz,
                        )
                        if depth <= best:
                            break
                    best = max(best, depth)
        found[i] = best
    return found
