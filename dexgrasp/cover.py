"""A link's surface in patches, each within a ball that hardly stands out of the link, and a tree of balls above them.

A ball that holds a patch and has its centre deep inside the link follows the patch about as closely as a ball
inscribed in the link would: what bounds the distance to one bounds it to the other. Unlike inscribed balls, which
touch the surface here and there, these leave nothing out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, cKDTree

from dexgrasp.ball_tree import inscribed, planes
from dexgrasp.kinematics import LinkRecord

PIECE = 2.5e-3
"""Patches are made of pieces of faces, with edges of at most this, m."""
TOLERANCE = 1.3e-3
"""How far balls may stand out, m; but more at sharp edges."""
STILL = 1e-9
"""Speed of what does not move, such as centres on a joint's axis, m."""
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


PER_FINGER = ("speeds", "patch_speeds", "bends")


def hand_cover(
    links: Sequence[LinkRecord],
    parts: Mapping[str, Sequence[trimesh.Trimesh]],
    limits: np.ndarray,
    rates: np.ndarray,
) -> Cover:
    """Cover those links that fingers move: by full joints' velocities (F, M), within limits (M, 2)."""
    known: dict[bytes, tuple[Cover, list[np.ndarray]]] = {}  # the fingers of a hand are often alike
    trees: list[Cover] = []
    roots, moving = np.full(len(links), -1), np.zeros(len(links), dtype=bool)
    count = first = total = 0
    for number, link in enumerate(links):
        moving[number] = link.parent >= 0 and moving[link.parent]
        moving[number] |= link.index >= 0 and bool(rates[:, link.index].any())
        bodies = parts.get(link.name, ())
        if bodies and moving[number]:
            key = b"".join(np.asarray(part.vertices).tobytes() for part in bodies)
            if key not in known:
                known[key] = _link_cover(bodies)
            tree, surface = known[key]
            cuts = np.cumsum([len(points) for points in surface])[:-1]
            of_centers, of_points = (
                np.array([_speeds(points, number, links, limits, rate) for rate in rates])
                for points in (tree.balls[:, :3], np.concatenate(surface))
            )  # (F, 2, K)
            most = np.stack(
                [p.max(axis=2, initial=STILL) for p in np.split(of_points, cuts, axis=2)],
                axis=2,
            )
            trees.append(
                tree._replace(
                    children=np.where(tree.children < 0, -1, tree.children + count),
                    spans=tree.spans[:-1] + total,
                    parts=np.where(tree.parts < 0, -1, tree.parts + first),
                    links=np.full(len(tree.balls), number),
                    speeds=of_centers[:, 0],
                    patch_speeds=most[:, 0],
                    bends=most[:, 1],
                )
            )
            roots[number] = count
            count += len(tree.balls)
            total += len(tree.points)
        first += len(bodies)
    joined = {
        name: np.concatenate([getattr(tree, name) for tree in trees], axis=int(name in PER_FINGER))
        for name in Cover._fields
        if name != "roots"
    }
    return Cover(**joined | {"roots": roots, "spans": np.append(joined["spans"], total)})


def _speeds(
    points: np.ndarray,
    link: int,
    links: Sequence[LinkRecord],
    limits: np.ndarray,
    rate: np.ndarray,
) -> np.ndarray:
    """Bound speed and acceleration (2, K) of points (K, 3) of a link, whatever the posture, at joint speeds `rate`.

    Moving joints i and k at once, k below i or i itself, accelerates a point by at most its distance to k's axis.
    """
    speeds, bends, reach = (
        np.zeros(len(points)),
        np.zeros(len(points)),
        np.zeros(len(points)),
    )
    turned = False
    while link >= 0:
        record = links[link]
        velocity = abs(rate[record.index]) if record.index >= 0 else 0.0
        # Distances to the axis of the joint at hand: exact for the last one, bounded by the chain's lengths above it.
        if record.kind == "revolute":
            speed = velocity * (reach if turned else np.linalg.norm(np.cross(points, record.axis), axis=1))
            bends += velocity * (speed + 2 * speeds)
            speeds += speed
        elif record.kind == "prismatic":
            speeds += velocity
        if not turned and record.kind == "fixed":
            points = points @ record.parent_T_joint[:3, :3].T + record.parent_T_joint[:3, 3]
        else:
            if not turned:
                turned, reach = True, np.linalg.norm(points, axis=1)
            if record.kind == "prismatic":
                reach = reach + np.abs(limits[record.index]).max()
            reach = reach + np.linalg.norm(record.parent_T_joint[:3, 3])
        link = record.parent
    return np.maximum([speeds, bends], STILL)


def _link_cover(parts: Sequence[trimesh.Trimesh]) -> tuple[Cover, list[np.ndarray]]:
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
