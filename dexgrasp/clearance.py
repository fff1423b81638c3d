"""Whether hands keep clear of a table, fixed boxes and objects, in a posture and on the straight way to it.

The table comes first: it forbids most grasps, and needs but the heights of the links. An object is met first as the
ball about it, then by the ball trees of the links that come near; only at their leaves, exact distances are asked for.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.collision import HandShape, as_arrays, way_clear
from dexgrasp.distance import DistanceField, Field
from dexgrasp.geometry import inverse
from dexgrasp.hand_body import HandBody, carry, place_links
from dexgrasp.scene import Boxes

CHUNK = 4096
"""Postures whose links are kept at a time."""
PLACES = 7
"""Places along the way at which a few balls of each link are tried first: most of what collides is found there."""


def above_table(
    shape: HandShape, pose: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"], retreat: float, least: float
) -> Bool[Tensor, "N"]:
    """Tell which hands stay `least` (m) above the plane z = 0 while they back away along the palm by `retreat` (m)."""
    backward = -shape.hand.base_T_palm[:3, 2].numpy()
    return torch.from_numpy(_above(shape.body, shape.corners, *as_arrays(pose, joints), backward, retreat, least))


def clear_way(
    shape: HandShape,
    pose: Float[Tensor, "N 4 4"],
    joints: Float[Tensor, "N J"],
    retreat: float,
    margin: float,
    own: Int[Tensor, "N"],
    poses: Float[Tensor, "O 4 4"],
    fields: Sequence[DistanceField],
    boxes: Boxes,
) -> Bool[Tensor, "N"]:
    """Tell which hands keep clear of boxes and objects while they back away along the palm by `retreat` (m).

    They stay `margin` (m) away from boxes and from all objects but the one that they grasp, which is `own`. `pose` is
    world_T_base, `poses` world_T_object.
    """
    body, backward = shape.body, -shape.hand.base_T_palm[:3, 2].numpy()
    object_T_world = np.ascontiguousarray(inverse(poses.double()).numpy()[:, :3])
    box_T_world = np.ascontiguousarray(inverse(boxes.poses.double()).numpy()[:, :3])
    halves, owners = boxes.halves.double().numpy(), own.numpy()
    clear = np.ones(len(pose), dtype=bool)
    for first in range(0, len(pose), CHUNK):
        rows = slice(first, first + CHUNK)
        links, ways = _place(body, *as_arrays(pose[rows], joints[rows]), backward)
        _avoid_boxes(body, box_T_world, halves, links, ways, retreat, margin, clear[rows])
        for number, field in enumerate(fields):
            frame, others = object_T_world[number], owners[rows] != number
            _avoid_object(body, shape.cores, field.field, frame, links, ways, others, retreat, margin, clear[rows])
    return torch.from_numpy(clear)


@njit(cache=True)
def _hits(
    body: HandBody,
    cores: np.ndarray,
    field: Field,
    poses: np.ndarray,
    near: np.ndarray,
    direction: np.ndarray,
    retreat: float,
    margin: float,
) -> bool:
    """Return whether some balls surely come nearer to an object than `margin`: by upper bounds from single nodes."""
    h = field.spacing
    nx, ny, nz = field.values.shape
    for link in range(len(cores)):
        if not near[link]:
            continue
        for ball in cores[link]:
            if ball < 0:
                break
            x, y, z = carry(poses, link, body.balls, ball)
            for place in range(PLACES if retreat > 0 else 1):
                way = retreat * place / (PLACES - 1)
                u = (x + way * direction[0] - field.origin[0]) / h
                v = (y + way * direction[1] - field.origin[1]) / h
                w = (z + way * direction[2] - field.origin[2]) / h
                if u < 0 or v < 0 or w < 0 or u > nx - 1 or v > ny - 1 or w > nz - 1:
                    continue
                i, j, k = int(u + 0.5), int(v + 0.5), int(w + 0.5)
                away = h * np.sqrt((u - i) ** 2 + (v - j) ** 2 + (w - k) ** 2)
                if field.values[i, j, k] + away + 1e-6 < body.balls[ball, 3] + margin:
                    return True
    return False


@njit(cache=True)
def _above(
    body: HandBody,
    corners: np.ndarray,
    bases: np.ndarray,
    joints: np.ndarray,
    backward: np.ndarray,
    retreat: float,
    least: float,
) -> np.ndarray:
    body, bases, joints = borrowed(body), borrowed(bases), borrowed(joints)
    above = np.ones(len(bases), np.bool_)
    rows = np.empty((len(body.parents), 4))
    for i in range(len(bases)):
        _place_rows(body, joints[i], bases[i, 2], rows)
        # Height is linear along a straight way without turning: its ends suffice.
        rise = bases[i, 2, 0] * backward[0] + bases[i, 2, 1] * backward[1] + bases[i, 2, 2] * backward[2]
        floor = least - min(0.0, retreat * rise)
        for p in range(len(body.part_links)):
            row, ball = rows[body.part_links[p]], body.part_balls[p]
            if row[0] * ball[0] + row[1] * ball[1] + row[2] * ball[2] + row[3] - ball[3] >= floor:
                continue
            for v in range(corners[p], corners[p + 1]):
                corner = body.vertices[v]
                if row[0] * corner[0] + row[1] * corner[1] + row[2] * corner[2] + row[3] < floor:
                    above[i] = False
                    break
            if not above[i]:
                break
    return above


@njit(cache=True, error_model="numpy")
def _place_rows(body: HandBody, joints: np.ndarray, base: np.ndarray, rows: np.ndarray) -> None:
    """Write of each link's pose the row that tells heights, as `place_links` does all three; `base` is that row."""
    for link in range(len(rows)):
        motion, parent, drive = body.motions[link], body.parents[link], body.drives[link]
        u = base if parent < 0 else rows[parent]
        a = u[0] * motion[6] + u[1] * motion[10] + u[2] * motion[14]
        b = u[0] * motion[7] + u[1] * motion[11] + u[2] * motion[15]
        d = u[0] * motion[8] + u[1] * motion[12] + u[2] * motion[16]
        t = u[0] * motion[9] + u[1] * motion[13] + u[2] * motion[17] + u[3]
        if drive >= 0:
            x, y, z = body.axes[link]
            q = body.offset[drive]
            for j in range(len(joints)):
                q += body.coupling[drive, j] * joints[j]
            along = a * x + b * y + d * z
            if body.kinds[link] == 2:
                t += q * along
            else:  # Rodrigues, from the right
                s, c = np.sin(q), np.cos(q)
                along *= 1 - c
                a, b, d = (
                    a * c + (b * z - d * y) * s + along * x,
                    b * c + (d * x - a * z) * s + along * y,
                    d * c + (a * y - b * x) * s + along * z,
                )
        rows[link, 0], rows[link, 1], rows[link, 2], rows[link, 3] = a, b, d, t


@njit(cache=True)
def _place(
    body: HandBody, bases: np.ndarray, joints: np.ndarray, backward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return world_T_link (N, L, 3, 4) and the directions in which hands back away (N, 3)."""
    body, bases, joints = borrowed(body), borrowed(bases), borrowed(joints)
    links, ways = np.empty((len(bases), len(body.parents), 3, 4)), np.empty((len(bases), 3))
    full = np.empty(len(body.offset))
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, links[i])
        for k in range(3):
            ways[i, k] = bases[i, k, 0] * backward[0] + bases[i, k, 1] * backward[1] + bases[i, k, 2] * backward[2]
    return links, ways


@njit(cache=True)
def _avoid_object(
    body: HandBody,
    cores: np.ndarray,
    field: Field,
    frame: np.ndarray,
    links: np.ndarray,
    ways: np.ndarray,
    others: np.ndarray,
    retreat: float,
    margin: float,
    clear: np.ndarray,
) -> None:
    """Take away the flags of hands that come nearer to an object than `margin`; `frame` is object_T_world (3, 4)."""
    body, cores, field, links = borrowed(body), borrowed(cores), borrowed(field), borrowed(links)
    frame, ways = borrowed(frame), borrowed(ways)
    poses, direction, near = np.empty(links.shape[1:]), np.empty(3), np.empty(len(body.roots), np.bool_)
    box = field.tree.boxes[0]
    middle, around = (box[:3] + box[3:]) / 2, np.sqrt(((box[3:] - box[:3]) ** 2).sum()) / 2
    centre = frame[:, :3].T.copy() @ (middle - frame[:, 3])
    for i in range(len(links)):
        if not clear[i] or not others[i]:
            continue
        a, b, c = ways[i]
        found = False
        for link in range(len(body.roots)):
            near[link] = False
            if body.roots[link] < 0:
                continue
            x, y, z = carry(links[i], link, body.balls, body.roots[link])
            x, y, z = centre[0] - x, centre[1] - y, centre[2] - z
            along = min(max(x * a + y * b + z * c, 0.0), retreat)
            x, y, z = x - along * a, y - along * b, z - along * c
            reach = around + body.balls[body.roots[link], 3] + margin
            if x * x + y * y + z * z < reach * reach:
                near[link] = found = True
                _compose(frame, links[i, link], poses[link])
        if found:
            for k in range(3):
                direction[k] = frame[k, 0] * a + frame[k, 1] * b + frame[k, 2] * c
            clear[i] = not _hits(body, cores, field, poses, near, direction, retreat, margin)
            clear[i] = clear[i] and way_clear(body, field, poses, near, direction, retreat, -margin)


@njit(cache=True)
def _compose(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write the product of rigid motions (3, 4)."""
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
        out[i, 3] += a[i, 3]


@njit(cache=True)
def _avoid_boxes(
    body: HandBody,
    frames: np.ndarray,
    halves: np.ndarray,
    links: np.ndarray,
    ways: np.ndarray,
    retreat: float,
    margin: float,
    clear: np.ndarray,
) -> None:
    """Take away the flags of hands that come nearer to a box than `margin`; `frames` are box_T_world (K, 3, 4)."""
    body, links, ways, halves = borrowed(body), borrowed(links), borrowed(ways), borrowed(halves)
    poses, direction = np.empty(links.shape[1:]), np.empty(3)
    stack, since = np.empty(256, np.int64), np.empty(256)
    for number in range(len(frames)):
        frame, half = frames[number], halves[number]
        for i in range(len(links)):
            for k in range(3):
                direction[k] = frame[k, 0] * ways[i, 0] + frame[k, 1] * ways[i, 1] + frame[k, 2] * ways[i, 2]
            for link in range(len(body.roots)):
                if body.roots[link] < 0 or not clear[i]:
                    continue
                _compose(frame, links[i, link], poses[link])
                stack[0], since[0], top = body.roots[link], 0.0, 1
                while top:
                    top -= 1
                    node, way = stack[top], since[top]
                    x, y, z = carry(poses, link, body.balls, node)
                    while way <= retreat:
                        u, v, w = x + way * direction[0], y + way * direction[1], z + way * direction[2]
                        gap = _box_distance(half, u, v, w) - body.balls[node, 3] - margin
                        if gap < 0:
                            if body.children[node, 0] < 0:
                                clear[i], top = False, 0
                            else:
                                stack[top], stack[top + 1] = body.children[node, 0], body.children[node, 1]
                                since[top], since[top + 1] = way, way
                                top += 2
                            break
                        way += max(gap, 2e-4)


@njit(cache=True)
def _box_distance(half: np.ndarray, x: float, y: float, z: float) -> float:
    """Return the signed distance to a box about the origin, m."""
    dx, dy, dz = abs(x) - half[0], abs(y) - half[1], abs(z) - half[2]
    outside = np.sqrt(max(dx, 0.0) ** 2 + max(dy, 0.0) ** 2 + max(dz, 0.0) ** 2)
    return outside + min(max(dx, dy, dz), 0.0)
