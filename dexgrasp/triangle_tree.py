"""Exact nearest point on a triangle mesh: a tree of boxes, and signs from pseudonormals."""

from typing import NamedTuple

import numpy as np
import trimesh
from numba import njit

LEAF = 4
"""Triangles in a leaf."""


class TriangleTree(NamedTuple):
    """A mesh as arrays that compiled code reads; triangles stand in the order of the tree's leaves."""

    boxes: np.ndarray
    """(M, 6) lower and upper corner of each node, m, in pre-order; node 0 is the root."""
    skips: np.ndarray
    """(M,) the next node that is not below this one: a leaf's is the node after it."""
    firsts: np.ndarray
    """(M + 1,) the first triangle below each node."""
    corners: np.ndarray
    """(T, 3, 3) corners of the triangles, m."""
    normals: np.ndarray
    """(T, 7, 3) unit pseudonormals of face, edges 01, 12, 20, corners 0, 1, 2 (Baerentzen & Aanaes 2005)."""


def triangle_tree(mesh: trimesh.Trimesh) -> TriangleTree:
    """Return the tree of a mesh (m)."""
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    corners = np.ascontiguousarray(vertices[faces])
    order, boxes, skips, firsts = _build(corners)
    return TriangleTree(boxes, skips, firsts, corners[order], _pseudonormals(corners, faces)[order])


def _pseudonormals(corners: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normals = np.zeros((len(faces), 7, 3))
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=-1, keepdims=True)
    edges = edges / np.maximum(lengths, 1e-300)
    normals[:, 0] = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    angles = np.arccos(np.clip(-(edges * np.roll(edges, 1, axis=1)).sum(-1), -1, 1))
    at_vertex = np.zeros((faces.max() + 1, 3))
    np.add.at(at_vertex, faces, angles[..., None] * normals[:, :1])
    normals[:, 4:] = _unit(at_vertex[faces])
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)
    keys, inverse = np.unique(ends[..., 0] * (faces.max() + 1) + ends[..., 1], return_inverse=True)
    at_edge = np.zeros((len(keys), 3))
    inverse = inverse.reshape(faces.shape)
    np.add.at(at_edge, inverse, np.repeat(normals[:, :1], 3, axis=1))
    normals[:, 1:4] = _unit(at_edge[inverse])
    return normals


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


@njit(cache=True)
def _build(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    count = len(corners)
    order = np.arange(count)
    boxes = np.empty((2 * count + 1, 6))
    skips, firsts = np.empty(2 * count + 1, np.int64), np.empty(2 * count + 1, np.int64)
    waiting = np.empty((128, 2), np.int64)  # first triangle and end of nodes that are not made yet
    above = np.empty((128, 2), np.int64)  # nodes above, and their ends
    waiting[0] = (0, count)
    top, nodes, depth = 1, 0, 0
    while top:
        top -= 1
        first, end = waiting[top]
        node = nodes
        nodes += 1
        while depth and above[depth - 1, 1] <= first:
            depth -= 1
            skips[above[depth, 0]] = node
        above[depth] = (node, end)
        depth += 1
        firsts[node] = first
        axis, widest = 0, -1.0
        for k in range(3):
            low, high, inner, outer = np.inf, -np.inf, np.inf, -np.inf
            for t in range(first, end):
                middle = 0.0
                for v in range(3):
                    value = corners[order[t], v, k]
                    low, high = min(low, value), max(high, value)
                    middle += value
                inner, outer = min(inner, middle), max(outer, middle)
            boxes[node, k], boxes[node, k + 3] = low, high
            if outer - inner > widest:
                axis, widest = k, outer - inner
        if end - first <= LEAF:
            continue
        middles = np.empty(end - first)
        for t in range(first, end):
            middles[t - first] = corners[order[t], 0, axis] + corners[order[t], 1, axis] + corners[order[t], 2, axis]
        order[first:end] = order[first:end][np.argsort(middles)]
        half = (first + end) // 2
        waiting[top] = (half, end)
        waiting[top + 1] = (first, half)
        top += 2
    for k in range(depth):
        skips[above[k, 0]] = nodes
    firsts[nodes] = count
    return order, boxes[:nodes].copy(), skips[:nodes].copy(), firsts[: nodes + 1].copy()


@njit(cache=True)
def to_triangle(corners: np.ndarray, t: int, x: float, y: float, z: float) -> tuple[float, float, float, int]:
    """Return squared distance, barycentric weights of corners 1 and 2, and the feature nearest to a point.

    Regions after Ericson, Real-Time Collision Detection, 5.1.5; features are numbered as in `TriangleTree.normals`.
    """
    ax, ay, az = corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]
    e1x, e1y, e1z = corners[t, 1, 0] - ax, corners[t, 1, 1] - ay, corners[t, 1, 2] - az
    e2x, e2y, e2z = corners[t, 2, 0] - ax, corners[t, 2, 1] - ay, corners[t, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    d1 = e1x * px + e1y * py + e1z * pz
    d2 = e2x * px + e2y * py + e2z * pz
    g11 = e1x * e1x + e1y * e1y + e1z * e1z
    g12 = e1x * e2x + e1y * e2y + e1z * e2z
    g22 = e2x * e2x + e2y * e2y + e2z * e2z
    d3, d4, d5, d6 = d1 - g11, d2 - g12, d1 - g12, d2 - g22
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0 and d2 <= 0:
        v, w, feature = 0.0, 0.0, 4
    elif d3 >= 0 and d4 <= d3:
        v, w, feature = 1.0, 0.0, 5
    elif d6 >= 0 and d5 <= d6:
        v, w, feature = 0.0, 1.0, 6
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v, w, feature = d1 / max(d1 - d3, 1e-300), 0.0, 1
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v, w, feature = 0.0, d2 / max(d2 - d6, 1e-300), 3
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        w = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300)
        v, feature = 1.0 - w, 2
    else:
        total = max(va + vb + vc, 1e-300)
        v, w, feature = vb / total, vc / total, 0
    rx, ry, rz = px - v * e1x - w * e2x, py - v * e1y - w * e2y, pz - v * e1z - w * e2z
    return rx * rx + ry * ry + rz * rz, v, w, feature


@njit(cache=True)
def to_box(boxes: np.ndarray, node: int, x: float, y: float, z: float) -> float:
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], 0.0)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], 0.0)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True)
def nearest(tree: TriangleTree, x: float, y: float, z: float, seed: int, out: np.ndarray) -> int:
    """Write (signed distance, point, outward unit normal), 7 numbers, to `out`; return the nearest triangle.

    `seed` is a triangle that is probably near. The normal is the direction of steepest distance; on the surface
    itself it is the pseudonormal.
    """
    boxes, skips, firsts, corners, normals = tree
    best, v, w, feature = to_triangle(corners, seed, x, y, z)
    triangle = seed
    node, count = 0, len(boxes)
    while node < count:
        if to_box(boxes, node, x, y, z) >= best:
            node = skips[node]
            continue
        if skips[node] == node + 1:
            for t in range(firsts[node], firsts[node + 1]):
                square, v_t, w_t, feature_t = to_triangle(corners, t, x, y, z)
                if square < best:
                    best, v, w, feature, triangle = square, v_t, w_t, feature_t, t
        node += 1
    nx, ny, nz = normals[triangle, feature, 0], normals[triangle, feature, 1], normals[triangle, feature, 2]
    distance = np.sqrt(best)
    for k in range(3):
        a = corners[triangle, 0, k]
        out[1 + k] = a + v * (corners[triangle, 1, k] - a) + w * (corners[triangle, 2, k] - a)
    side = (x - out[1]) * nx + (y - out[2]) * ny + (z - out[3]) * nz
    sign = 1.0 if side >= 0 else -1.0
    out[0] = sign * distance
    if distance > 1e-9:
        out[4] = sign * (x - out[1]) / distance
        out[5] = sign * (y - out[2]) / distance
        out[6] = sign * (z - out[3]) / distance
    else:
        out[4], out[5], out[6] = nx, ny, nz
    return triangle
