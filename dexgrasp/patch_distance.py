"""How long a patch of a moving link's surface surely stays clear of an object's triangles."""

import numpy as np
from numba import njit

from dexgrasp.convex_distance import Polytopes, support, to_polytope
from dexgrasp.triangle_tree import TriangleTree, to_box, to_triangle

SCRATCH = (8, 4, 3)
"""Shape of the array that `patch_time` works in."""

ENOUGH = 0.6
"""A triangle that is told to be reached no sooner than after this part of the time known so far needs no other look."""


@njit(cache=True, error_model="numpy")
def patch_time(
    shapes: Polytopes,
    tree: TriangleTree,
    pose: np.ndarray,
    twist: np.ndarray,
    part: int,
    way: np.ndarray,
    seed: int,
    radius: float,
    speed: float,
    bend: float,
    horizon: float,
    touch: float,
    spare: float,
    work: np.ndarray,
    hit: np.ndarray,
) -> float:
    """Return a time, at most `horizon`, for which a patch stays clear of the object by `spare` (m); -1 if it touches.

    The patch belongs to a convex part and lies in a ball with `radius` whose centre, in the object's frame, work[7, 0]
    holds. No point of it moves faster than `speed` or accelerates more than `bend`; `twist` (6,) is the link's: angular
    velocity and the velocity of what is at the origin. `pose` is object_T_link. `way` is the unit direction, in the
    object's frame, from the part to the object, along which the two were apart last: a guess, that becomes the new one.
    The part touches triangles within `touch`: then `hit` becomes the distance, the object's nearest point and the unit
    direction from there to the part; 0 and the object's normal for overlap.

    What lies beyond a plane in front of the patch stays untouched for as long as the patch needs to that plane: it
    moves there as its ball's centre does, but for what the ball's turning and the acceleration may add.
    """
    boxes, skips, firsts, corners, normals = tree
    corner = shapes.firsts[part]
    triangle, told, aim, plane = work[5], work[4], work[6, 0], work[6, 1]
    x, y, z = work[7, 0]
    best = horizon
    front, rate, corner = _front(shapes, corner, pose, twist, way, x, y, z, radius, work[6, 2])
    gap = _low(corners, seed, way) - front
    clear = _until(gap - spare, rate, bend)
    # Or before the point that is nearest to the ball's centre, as far as the grid knows?
    square, v, w, _ = to_triangle(corners, seed, x, y, z)
    _towards(corners, seed, square, v, w, work[7, 0], plane)
    other, other_rate, corner = _front(shapes, corner, pose, twist, plane, x, y, z, radius, work[6, 2])
    other_gap = _low(corners, seed, plane) - other
    other_clear = _until(other_gap - spare, other_rate, bend)
    if other_clear > clear:
        gap, clear, front, rate = other_gap, other_clear, other, other_rate
        way[:] = plane
    if gap > 2 * touch:
        best = min(best, clear)
    floor, far, pace = ENOUGH * best, front, rate
    bar = front + spare + max(0.0, best * (rate + 0.5 * bend * best))
    around = (radius + spare + speed * best) ** 2
    at, count = 0, len(boxes)
    while at < count:
        if to_box(boxes, at, x, y, z) >= around or _box_along(boxes, at, way) >= bar:
            at = skips[at]
            continue
        if skips[at] > at + 1:
            at += 1
            continue
        for t in range(firsts[at], firsts[at + 1]):
            height = _low(corners, t, way)
            if height >= bar:
                continue
            square, v, w, _ = to_triangle(corners, t, x, y, z)
            if square >= around:
                continue
            time = _until(height - front - spare, rate, bend)
            if time > floor and height > front + touch:
                best, bar = time, height
                around = (radius + spare + speed * best) ** 2
                continue
            time = -1.0
            for guess in range(2):
                if guess == 0:
                    for i in range(3):
                        plane[i] = -normals[t, 0, i]
                else:
                    _towards(corners, t, square, v, w, work[7, 0], plane)
                other, other_rate, corner = _front(shapes, corner, pose, twist, plane, x, y, z, radius, work[6, 2])
                gap = _low(corners, t, plane) - other
                if gap > touch:
                    clear = _until(gap - spare, other_rate, bend)
                    if clear > time:
                        time, far, pace = clear, other, other_rate
                        work[7, 1] = plane
                        if time >= best:
                            break
            if time >= best:
                continue
            if time < ENOUGH * best:
                for k in range(3):
                    a, b, c = (
                        corners[t, k, 0] - pose[0, 3],
                        corners[t, k, 1] - pose[1, 3],
                        corners[t, k, 2] - pose[2, 3],
                    )
                    for i in range(3):
                        triangle[k, i] = pose[0, i] * a + pose[1, i] * b + pose[2, i] * c
                for i in range(3):
                    aim[i] = pose[0, i] * plane[0] + pose[1, i] * plane[1] + pose[2, i] * plane[2]
                gap, corner = to_polytope(shapes, corner, triangle, aim, 1.5 * touch, np.inf, work)
                for i in range(3):
                    plane[i] = pose[i, 0] * aim[0] + pose[i, 1] * aim[1] + pose[i, 2] * aim[2]
                if gap <= touch:
                    hit[0] = gap
                    for i in range(3):
                        hit[1 + i] = (
                            told[0, 0] * corners[t, 0, i]
                            + told[1, 0] * corners[t, 1, i]
                            + told[2, 0] * corners[t, 2, i]
                        )
                        hit[4 + i] = -plane[i] if gap > 0 else normals[t, 0, i]
                    return -1.0
                other, other_rate, corner = _front(shapes, corner, pose, twist, plane, x, y, z, radius, work[6, 2])
                clear = _until(_low(corners, t, plane) - other - spare, other_rate, bend)
                if clear > time:
                    time, far, pace = clear, other, other_rate
                    work[7, 1] = plane
                time = max(time, (gap - spare) / speed)
            best = min(best, time)
            way[:] = work[7, 1]
            front, rate = far, pace
            floor = ENOUGH * best
            bar = front + spare + max(0.0, best * (rate + 0.5 * bend * best))
            around = (radius + spare + speed * best) ** 2
        at += 1
    return best


@njit(cache=True, error_model="numpy")
def _towards(
    corners: np.ndarray, t: int, square: float, v: float, w: float, center: np.ndarray, way: np.ndarray
) -> None:
    """Write the unit direction from a point to the one nearest to it of triangle t, as `to_triangle` tells that."""
    u, length = 1.0 - v - w, np.sqrt(square)
    for i in range(3):
        way[i] = (u * corners[t, 0, i] + v * corners[t, 1, i] + w * corners[t, 2, i] - center[i]) / length


@njit(cache=True, error_model="numpy")
def _front(
    shapes: Polytopes,
    corner: int,
    pose: np.ndarray,
    twist: np.ndarray,
    way: np.ndarray,
    x: float,
    y: float,
    z: float,
    radius: float,
    local: np.ndarray,
) -> tuple[float, float, int]:
    """Return how far along a direction a patch reaches (m), how fast that grows at most, and the corner there."""
    a, b, c = way[0], way[1], way[2]
    for i in range(3):
        local[i] = pose[0, i] * a + pose[1, i] * b + pose[2, i] * c
    corner = support(shapes, corner, local[0], local[1], local[2])
    reach = along(shapes.corners, corner, local) + a * pose[0, 3] + b * pose[1, 3] + c * pose[2, 3]
    p, q, r = twist[0], twist[1], twist[2]
    rate = a * (twist[3] + q * z - r * y) + b * (twist[4] + r * x - p * z) + c * (twist[5] + p * y - q * x)
    u, v, w = q * c - r * b, r * a - p * c, p * b - q * a
    return (
        min(reach, a * x + b * y + c * z + radius),
        rate + radius * np.sqrt(u * u + v * v + w * w),
        corner,
    )


@njit(cache=True, error_model="numpy")
def _until(gap: float, rate: float, bend: float) -> float:
    """Return when rate t + bend t^2 / 2 reaches a gap; 0 where it has done so."""
    if gap <= 0:
        return 0.0
    root = np.sqrt(rate * rate + 2 * bend * gap)
    return 2 * gap / (rate + root) if rate > 0 else (root - rate) / bend


@njit(cache=True, error_model="numpy")
def _box_along(boxes: np.ndarray, node: int, way: np.ndarray) -> float:
    """Return how far along a direction the nearest corner of a box lies."""
    a, b, c = way[0], way[1], way[2]
    least = min(a * boxes[node, 0], a * boxes[node, 3]) + min(b * boxes[node, 1], b * boxes[node, 4])
    return least + min(c * boxes[node, 2], c * boxes[node, 5])


@njit(cache=True, error_model="numpy")
def _low(corners: np.ndarray, t: int, way: np.ndarray) -> float:
    """Return how far along a direction the nearest corner of triangle t lies."""
    a, b, c = way[0], way[1], way[2]
    u = a * corners[t, 0, 0] + b * corners[t, 0, 1] + c * corners[t, 0, 2]
    v = a * corners[t, 1, 0] + b * corners[t, 1, 1] + c * corners[t, 1, 2]
    w = a * corners[t, 2, 0] + b * corners[t, 2, 1] + c * corners[t, 2, 2]
    return min(u, v, w)


@njit(cache=True, error_model="numpy")
def along(corners: np.ndarray, k: int, way: np.ndarray) -> float:
    """Return how far along a direction corner k lies."""
    return corners[k, 0] * way[0] + corners[k, 1] * way[1] + corners[k, 2] * way[2]
