"""A link's surface in patches, each within a ball that hardly stands out of the link, and a tree of balls above them.

A ball that holds a patch and has its centre deep inside the link follows the patch about as closely as a ball
inscribed in the link would: what bounds the distance to one bounds it to the other. Unlike inscribed balls, which
touch the surface here and there, these leave nothing out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, cKDTree

from dexgrasp.ball_tree import inscribed, planes
from dexgrasp.link_shape import once_per_shape

PIECE = 2.5e-3
"""Patches are made of pieces of faces, with edges of at most this, m."""
TOLERANCE = 1.3e-3
"""How far balls may stand out, m; but more at sharp edges."""
FLAT = 1e-9
"""Patches thinner than this are plane, m."""
GAIN = 1e-3
"""Splitting a ball is taken to gain at least this, m."""


class Cover(NamedTuple):
    """M balls in the frames of their links, m; a parent comes before its children."""

    balls: np.ndarray
    """(M, 4) centre and radius: the surface below lies in the ball."""
    children: np.ndarray
    """(M, 2); -1 for a leaf, which holds one patch."""
    gains: np.ndarray
    """(M,) how much closer, about, the surface is followed after splitting; 0 for a leaf."""
    points: np.ndarray
    """(K, 3) corners of the hulls of all patches."""
    spans: np.ndarray
    """(M + 1,) the first point of each node; only leaves have any."""
    patch_balls: np.ndarray
    """(M, 4) ball that holds the patch of a leaf, and little else."""
    parts: np.ndarray
    """(M,) the convex part, of all the hand's, that a leaf's patch lies on; -1 for other nodes."""
    links: np.ndarray
    """(M,)."""
    roots: np.ndarray
    """(L,) root of each link's tree; -1 where no finger moves the link, or without collision geometry."""
    speeds: np.ndarray
    """(F, M) bound of a centre's speed per unit of a finger's closing parameter, whatever the posture."""
    patch_speeds: np.ndarray
    """(F, M) the same for every point of a leaf's patch."""
    bends: np.ndarray
    """(F, M) bound of the acceleration of these points at a constant closing speed."""


@once_per_shape
def link_cover(parts: Sequence[trimesh.Trimesh]) -> tuple[Cover, list[np.ndarray]]:
    """Cover the surface of a union of convex parts; return the tree and the points (K, 3) of the patch in each leaf."""
    sides = [planes(part) for part in parts]
    leaves, patches, owners = [], [], []
    for number, part in enumerate(parts):
        pieces, normals = _pieces(part)
        buried = np.zeros(len(pieces), dtype=bool)
        for other, side in enumerate(sides):
            if other != number:
                buried |= ((pieces @ side[:, :3].T - side[:, 3]).max(axis=2) < -1e-6).all(axis=1)
        pieces, normals = pieces[~buried], normals[~buried]
        if not len(pieces):
            continue
        balls, chosen = _patches(pieces, normals, sides[number])
        for ball in np.unique(chosen):
            leaves.append(balls[ball])
            patches.append(np.unique(pieces[chosen == ball].reshape(-1, 3), axis=0))
            owners.append(number)
    return _tree(np.array(leaves), patches, np.array(owners), sides)


def _pieces(part: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return small triangles (K, 3, 3) that make up a part's surface, and their normals (K, 3)."""
    vertices, faces, index = trimesh.remesh.subdivide_to_size(
        part.vertices, part.faces, PIECE, max_iter=20, return_index=True
    )
    return np.asarray(vertices)[faces], part.face_normals[index]


def _patches(pieces: np.ndarray, normals: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return balls (B, 4) inscribed in a part and which of them each piece of its surface is given to."""
    points = pieces.mean(axis=1)
    radii = inscribed(points, normals, sides)
    centers = points - radii[:, None] * normals
    near, bare, kept = cKDTree(points), np.ones(len(points), dtype=bool), []
    for place in np.lexsort((*centers.T, -np.round(radii, 6))):  # large balls first
        if not bare[place]:
            continue
        reach = radii[place] + TOLERANCE
        about = np.array(near.query_ball_point(centers[place], reach), dtype=int)
        about = about[bare[about]]
        about = about[np.linalg.norm(pieces[about] - centers[place], axis=2).max(axis=1) <= reach]
        bare[about] = bare[place] = False
        kept.append(place)
    balls = np.column_stack([centers, radii])[kept]
    least, chosen = np.full(len(points), np.inf), np.zeros(len(points), dtype=int)
    for ball, (*center, radius) in enumerate(balls):
        about = np.array(near.query_ball_point(center, radius + 2 * TOLERANCE), dtype=int)
        stands = np.linalg.norm(pieces[about] - center, axis=2).max(axis=1) - radius
        better = stands < least[about] - 1e-9
        chosen[about[better]], least[about[better]] = ball, stands[better]
    assert np.isfinite(least).all()  # every piece is near the ball that covered it
    return balls, chosen


def _tree(
    leaves: np.ndarray,
    patches: list[np.ndarray],
    owners: np.ndarray,
    sides: list[np.ndarray],
) -> tuple[Cover, list[np.ndarray]]:
    count = 2 * len(leaves) - 1
    none = np.zeros(0)  # what only the hand knows
    made = Cover(np.zeros((count, 4)), np.full((count, 2), -1), np.zeros(count), none, np.zeros(count + 1, dtype=int),
                 np.zeros((count, 4)), np.full(count, -1), none, none, none, none, none)  # fmt: skip
    corners = list[np.ndarray]()
    middles = np.array([points.mean(axis=0) for points in patches])
    stands, surface = np.zeros(count), list[np.ndarray]()
    stack = [(np.arange(len(leaves)), -1, 0)]
    while stack:
        members, parent, side = stack.pop()
        node = len(surface)
        points = np.concatenate([patches[member] for member in members])
        surface.append(points if len(members) == 1 else points[:0])
        if parent >= 0:
            made.children[parent, side] = node
        centers = leaves[members[:: -(-len(members) // 16)], :3]
        if len(members) == 1:
            made.parts[node] = owners[members[0]]
            corners.append(_extreme(points))
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            made.patch_balls[node] = *middle, np.linalg.norm(points - middle, axis=1).max()
            made.spans[node + 1] = len(corners[-1])
        else:
            centers = np.concatenate(
                [
                    centers,
                    [
                        points.mean(axis=0),
                        (points.min(axis=0) + points.max(axis=0)) / 2,
                    ],
                ]
            )
            order = np.argsort(
                middles[members, int(np.ptp(middles[members], axis=0).argmax())],
                kind="stable",
            )
            half = len(members) // 2
            stack += [
                (members[order[half:]], node, 1),
                (members[order[:half]], node, 0),
            ]
        radii = np.linalg.norm(points[:, None] - centers, axis=2).max(axis=0)
        depths = np.max(
            [(body[:, 3] - centers @ body[:, :3].T).min(axis=1) for body in sides],
            axis=0,
        )
        best = int((radii - np.maximum(depths, 0)).argmin())
        made.balls[node] = (*centers[best], radii[best])
        stands[node] = radii[best] - max(depths[best], 0)
    inside = made.children[:, 0] >= 0
    made.gains[inside] = np.maximum(stands[inside] - stands[made.children[inside]].max(axis=1), GAIN)
    return made._replace(points=np.concatenate(corners), spans=np.cumsum(made.spans)), surface


def _extreme(points: np.ndarray) -> np.ndarray:
    """Return those points (K, 3) that span the hull of all, be it flat."""
    away = points - points.mean(axis=0)
    along = away @ np.linalg.svd(away, full_matrices=False)[2].T
    rank = int((np.ptp(along, axis=0) > FLAT).sum())
    if rank < 2 or len(points) <= rank + 1:
        return points
    return points[ConvexHull(along[:, :rank]).vertices]
