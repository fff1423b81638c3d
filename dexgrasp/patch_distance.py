"""How long a patch of a moving link's surface surely stays clear of an object's triangles."""

import numpy as np
from numba import njit

from dexgrasp.convex_distance import farthest, to_hull
from dexgrasp.triangle_tree import to_box, to_triangle

SCRATCH = (6, 4, 3)
"""Shape of the array that `patch_time` works in."""

ENOUGH = 0.4
"""A triangle that is told to be reached no sooner than after this part of the time known so far needs no other look."""


TINY = 1e-18
"""Squared distances below this have no direction, m2."""


@njit(cache=True, error_model="numpy")
def move_patch(
    points: np.ndarray, first: int, last: int, pose: np.ndarray, twist: np.ndarray, moved: np.ndarray
) -> float:
    """Write points first to last (K, 3) of a link to `moved` (3, K), in the object's frame; return the largest speed.

    `pose` is object_T_link (3, 4) and `twist` (6,) the link's: angular velocity, and the velocity of what is at the
    object's origin.
    """
    p, q, r, fastest = twist[0], twist[1], twist[2], 0.0
    for k in range(last - first):
        a, b, c = points[first + k, 0], points[first + k, 1], points[first + k, 2]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        moved[0, k], moved[1, k], moved[2, k] = x, y, z
        u, v, w = twist[3] + q * z - r * y, twist[4] + r * x - p * z, twist[5] + p * y - q * x
        fastest = max(fastest, u * u + v * v + w * w)
    return np.sqrt(fastest)


@njit(cache=True, error_model="numpy")
def patch_time(
    moved: np.ndarray,
    count: int,
    boxes: np.ndarray,
    skips: np.ndarray,
    firsts: np.ndarray,
    corners: np.ndarray,
    normals: np.ndarray,
    twist: np.ndarray,
    way: np.ndarray,
    seed: int,
    x: float,
    y: float,
    z: float,
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

    The patch is the hull of the first `count` points that `move_patch` wrote, and lies in a ball about
    (x, y, z); none of it moves faster than `speed` now or accelerates more than `bend`. `boxes` to `normals` are the
    object's `TriangleTree`. `way` is a unit direction from the patch to the object, along which the two may be apart: a
    guess, that becomes the best one. The patch touches triangles within `touch`: then `hit` becomes the distance, the
    object's nearest point and the unit direction from there to the patch; 0 and the object's normal for overlap.

    What lies beyond a plane in front of the patch stays untouched for as long as the patch needs to that plane.
    """
    told, plane, good = work[4], work[5, 0], work[5, 1]
    front, rate = _front(moved, count, twist, way)
    gap = _low(corners, seed, way) - front
    clear = _until(gap - spare, rate, bend)
    # Or before the point that is nearest to the ball's centre, as far as the grid knows?
    square, v, w, _ = to_triangle(corners, seed, x, y, z)
    for i in range(3):
        plane[i] = way[i]
    _towards(corners, seed, square, v, w, x, y, z, plane)
    other, other_rate = _front(moved, count, twist, plane)
    other_gap = _low(corners, seed, plane) - other
    other_clear = _until(other_gap - spare, other_rate, bend)
    if other_clear > clear:
        gap, clear, front, rate = other_gap, other_clear, other, other_rate
        for i in range(3):
            way[i] = plane[i]
    best = min(horizon, clear) if gap > 2 * touch else horizon
    floor, far, pace = ENOUGH * best, front, rate
    bar = front + spare + max(0.0, best * (rate + 0.5 * bend * best))
    around = (radius + spare + best * (speed + 0.5 * bend * best)) ** 2
    at, total = 0, len(boxes)
    while at < total:
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
                around = (radius + spare + best * (speed + 0.5 * bend * best)) ** 2
                continue
            time = -1.0
            for guess in range(3):
                if guess == 0:
                    for i in range(3):
                        plane[i] = -normals[t, 0, i]
                elif guess == 1:
                    _towards(corners, t, square, v, w, x, y, z, plane)
                elif time >= ENOUGH * best:
                    break
                else:
                    gap = to_hull(moved, count, corners, t, plane, 1.5 * touch, work)
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
                    time = max(time, 0.0)
                other, other_rate = _front(moved, count, twist, plane)
                gap = _low(corners, t, plane) - other
                clear = _until(gap - spare, other_rate, bend)
                if (gap > touch or guess == 2) and clear >= time:
                    time, far, pace = clear, other, other_rate
                    for i in range(3):
                        good[i] = plane[i]
                    if time >= best:
                        break
            if time >= best:
                continue
            best = min(best, time)
            for i in range(3):
                way[i] = good[i]
            front, rate = far, pace
            floor = ENOUGH * best
            bar = front + spare + max(0.0, best * (rate + 0.5 * bend * best))
            around = (radius + spare + best * (speed + 0.5 * bend * best)) ** 2
        at += 1
    return best


@njit(cache=True, error_model="numpy")
def _towards(
    corners: np.ndarray,
    t: int,
    square: float,
    v: float,
    w: float,
    x: float,
    y: float,
    z: float,
    way: np.ndarray,
) -> None:
    """Write the unit direction from a point to the one nearest to it of triangle t, as `to_triangle` tells that.

    None is written where the point lies on the triangle.
    """
    if square < TINY:
        return
    u, length = 1.0 - v - w, np.sqrt(square)
    way[0] = (u * corners[t, 0, 0] + v * corners[t, 1, 0] + w * corners[t, 2, 0] - x) / length
    way[1] = (u * corners[t, 0, 1] + v * corners[t, 1, 1] + w * corners[t, 2, 1] - y) / length
    way[2] = (u * corners[t, 0, 2] + v * corners[t, 1, 2] + w * corners[t, 2, 2] - z) / length


@njit(cache=True, error_model="numpy")
def _front(moved: np.ndarray, count: int, twist: np.ndarray, way: np.ndarray) -> tuple[float, float]:
    """Return how far along a direction a patch reaches (m), and how fast any of it moves that way."""
    a, b, c = way[0], way[1], way[2]
    p, q, r = twist[0], twist[1], twist[2]
    # The rate of a point x is way . (v + omega x x): linear in x, so that the fastest is a corner of the hull.
    reach, rate = farthest(moved, count, a, b, c, b * r - c * q, c * p - a * r, a * q - b * p)
    return reach, rate + a * twist[3] + b * twist[4] + c * twist[5]


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
