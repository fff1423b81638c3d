"""Exact distance between a patch of a link's surface and an object's triangles."""

import numpy as np
from numba import njit

from dexgrasp.convex_distance import Polytopes, support, to_polytope
from dexgrasp.triangle_tree import TriangleTree, to_box, to_triangle

SCRATCH = (8, 4, 3)
"""Shape of the array that `patch_distance` works in."""


@njit(cache=True, error_model="numpy")
def patch_distance(
    shapes: Polytopes,
    tree: TriangleTree,
    pose: np.ndarray,
    part: int,
    way: np.ndarray,
    radius: float,
    close: float,
    reach: float,
    work: np.ndarray,
    hit: np.ndarray,
) -> float:
    """Return a lower bound of the distance of a convex part to the object near one of its covering leaves, m.

    Only triangles within `reach` of the leaf's ball are looked at, which has `radius` and whose centre in the object's
    frame work[7, 0] holds: no other can be nearer to its patch. `pose` is object_T_link. `way` is the unit direction,
    in the link's frame, along which the two were apart last: a guess, that becomes the new one. The bound is at most
    `reach`; below `close` it is the distance itself, and `hit` becomes it, the object's nearest point and the unit
    direction from there to the part; 0 and the object's normal for overlap.
    """
    boxes, skips, firsts, corners, normals = tree
    corner = shapes.firsts[part]
    triangle, told, aim = work[5], work[4], work[6, 0]
    x, y, z = work[7, 0]
    best = reach
    corner = support(shapes, corner, way[0], way[1], way[2])
    height = along(shapes.corners, corner, way)
    around = (radius + best) * (radius + best)
    at, count = 0, len(boxes)
    while at < count:
        if to_box(boxes, at, x, y, z) >= around:
            at = skips[at]
            continue
        if skips[at] > at + 1:
            at += 1
            continue
        for t in range(firsts[at], firsts[at + 1]):
            square, v, w, _ = to_triangle(corners, t, x, y, z)
            if square >= around:
                continue
            for k in range(3):
                a, b, c = corners[t, k, 0] - pose[0, 3], corners[t, k, 1] - pose[1, 3], corners[t, k, 2] - pose[2, 3]
                for i in range(3):
                    triangle[k, i] = pose[0, i] * a + pose[1, i] * b + pose[2, i] * c
            # Apart along the last way, or against the triangle's normal, or from the ball's centre?
            distance = lowest(triangle, way) - height
            if distance >= best:
                continue
            if distance < close:
                for i in range(3):
                    aim[i] = (
                        -pose[0, i] * normals[t, 0, 0] - pose[1, i] * normals[t, 0, 1] - pose[2, i] * normals[t, 0, 2]
                    )
                corner = support(shapes, corner, aim[0], aim[1], aim[2])
                distance = lowest(triangle, aim) - along(shapes.corners, corner, aim)
                if distance < close:
                    u = 1.0 - v - w
                    a = u * corners[t, 0, 0] + v * corners[t, 1, 0] + w * corners[t, 2, 0] - x
                    b = u * corners[t, 0, 1] + v * corners[t, 1, 1] + w * corners[t, 2, 1] - y
                    c = u * corners[t, 0, 2] + v * corners[t, 1, 2] + w * corners[t, 2, 2] - z
                    length = np.sqrt(square)
                    for i in range(3):
                        aim[i] = (pose[0, i] * a + pose[1, i] * b + pose[2, i] * c) / length
                    corner = support(shapes, corner, aim[0], aim[1], aim[2])
                    distance = lowest(triangle, aim) - along(shapes.corners, corner, aim)
                    if distance < close:
                        distance, corner = to_polytope(shapes, corner, triangle, aim, close, best, work)
            else:
                aim[:] = way
            if distance >= best:
                continue
            best = distance
            around = (radius + best) * (radius + best)
            hit[0] = best
            for i in range(3):
                hit[1 + i] = (
                    told[0, 0] * corners[t, 0, i] + told[1, 0] * corners[t, 1, i] + told[2, 0] * corners[t, 2, i]
                )
                hit[4 + i] = -(pose[i, 0] * aim[0] + pose[i, 1] * aim[1] + pose[i, 2] * aim[2])
            if best <= 0:
                hit[4:7] = normals[t, 0]
                return 0.0
            way[:] = aim
            corner = support(shapes, corner, way[0], way[1], way[2])
            height = along(shapes.corners, corner, way)
        at += 1
    return best


@njit(cache=True, error_model="numpy")
def lowest(triangle: np.ndarray, way: np.ndarray) -> float:
    """Return how far along a direction the nearest corner of a triangle (3, 3) lies."""
    return min(along(triangle, 0, way), along(triangle, 1, way), along(triangle, 2, way))


@njit(cache=True, error_model="numpy")
def along(corners: np.ndarray, k: int, way: np.ndarray) -> float:
    """Return how far along a direction corner k lies."""
    return corners[k, 0] * way[0] + corners[k, 1] * way[1] + corners[k, 2] * way[2]
