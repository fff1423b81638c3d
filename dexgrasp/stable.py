"""Stable resting poses of a rigid body on a plane, with how likely each is after a random drop."""

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]


def stable_poses(
    vertices: Array, com: Array, merge: float = 0.17, least: float = 1e-3, most: int = 64
) -> tuple[Array, Array]:
    """Return world_T_object (K 4 4, m: rests on z = 0, centre of mass over the origin) and probabilities (K,).

    Quasi-static: a body dropped in a uniformly random orientation lands on the hull facet below its centre of mass
    (probability = the facet's solid angle seen from there) and tips over to the neighbour that lowers the centre of
    mass most until the facet holds the centre's foot. Poses within `merge` rad of a likelier one of the same height
    are one pose (a cylinder's side, a ball); those below probability `least` go; most likely first.
    """
    hull = ConvexHull(vertices, qhull_options="Qt Pp")
    corners = vertices[hull.simplices] - com
    normals, height = hull.equations[:, :3], -(hull.equations[:, 3] + hull.equations[:, :3] @ com)
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.einsum("ij,ij->i", turned, normals) > 0
    corners = np.where(outward[:, None, None], corners, corners[:, [0, 2, 1]])

    # Facets that are coplanar to 1e-3 rad act as one.
    count = len(normals)
    rows, columns = np.repeat(np.arange(count), 3), hull.neighbors.ravel()
    level = np.einsum("ij,ij->i", normals[rows], normals[columns]) > 1 - 5e-7
    links = coo_matrix((level[level], (rows[level], columns[level])), shape=(count, count))
    _, group = connected_components(links, directed=False)

    holds = _foot_inside(corners, normals, height)
    groups = int(group.max()) + 1
    steady = np.zeros(groups, dtype=bool)
    np.logical_or.at(steady, group, holds)
    lowest = np.full(groups, np.inf)
    np.minimum.at(lowest, group, height)
    target = np.arange(groups)
    order = np.argsort(-lowest[group[columns]], kind="stable")
    moves = order[(group[rows] != group[columns])[order]]
    target[group[rows[moves]]] = group[columns[moves]]
    stays = steady | (lowest[target] >= lowest)
    target[stays] = np.flatnonzero(stays)
    for _ in range(int(np.ceil(np.log2(groups + 1))) + 1):
        target = target[target]

    chance = np.zeros(groups)
    np.add.at(chance, target[group], _solid_angles(corners) / (4 * np.pi))
    leader = np.full(groups, -1)
    leader[group[holds][::-1]] = np.flatnonzero(holds)[::-1]
    ranked = [g for g in np.argsort(-chance, kind="stable") if chance[g] > 0 and leader[g] >= 0]
    kept: list[int] = []
    weights: list[float] = []
    for g in ranked:
        close = [
            k
            for k, other in enumerate(kept)
            if normals[leader[g]] @ normals[leader[other]] > np.cos(merge)
            and abs(lowest[g] - lowest[other]) < 0.02 * lowest[other]
        ]
        if close:
            weights[close[0]] += chance[g]
        else:
            kept.append(int(g))
            weights.append(float(chance[g]))
    share = np.array(weights)
    order = np.argsort(-share, kind="stable")[:most]
    order = order[share[order] >= min(least, share.max())]
    poses = np.array([_resting(normals[leader[kept[k]]], com, vertices) for k in order])
    return poses, share[order] / share[order].sum()


def _foot_inside(corners: Array, normals: Array, height: Array) -> NDArray[np.bool_]:
    """Whether the centre's foot on each facet's plane lies within the facet (N 3 3, relative to the centre)."""
    foot = normals * height[:, None]
    inside = np.ones(len(corners), dtype=bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, b] - corners[:, a]
        side = np.einsum("ij,ij->i", np.cross(edge, foot - corners[:, a]), normals)
        inside &= side >= -1e-9 * np.linalg.norm(edge, axis=1)
    return inside


def _solid_angles(corners: Array) -> Array:
    """Solid angle (sr) of triangles (N 3 3) from the origin (van Oosterom and Strackee 1983)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = np.einsum("ij,ij->i", a, b) * lc + np.einsum("ij,ij->i", b, c) * la + np.einsum("ij,ij->i", c, a) * lb
    return np.abs(2 * np.arctan2(triple, la * lb * lc + dots))


def _resting(down: Array, com: Array, vertices: Array) -> Array:
    """world_T_object with the direction `down` (object frame) on -z and the lowest point on z = 0."""
    rotation = trimesh.geometry.align_vectors(down, [0.0, 0.0, -1.0])[:3, :3]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ com
    pose[2, 3] = -(vertices @ rotation[2]).min()
    return pose
