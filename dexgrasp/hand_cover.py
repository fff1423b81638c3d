"""The cover of all links that a hand's fingers move, and how fast they move it."""

from collections.abc import Mapping, Sequence

import numpy as np
import trimesh

from dexgrasp.cover import Cover, link_cover
from dexgrasp.kinematics import LinkRecord

STILL = 1e-9
"""Speed of what does not move, such as centres on a joint's axis, m."""
PER_FINGER = ("speeds", "patch_speeds", "bends")


def hand_cover(
    links: Sequence[LinkRecord],
    parts: Mapping[str, Sequence[trimesh.Trimesh]],
    limits: np.ndarray,
    rates: np.ndarray,
) -> Cover:
    """Cover those links that fingers move: by full joints' velocities (F, M), within limits (M, 2)."""
    trees: list[Cover] = []
    roots, moving = np.full(len(links), -1), np.zeros(len(links), dtype=bool)
    count = first = total = 0
    for number, link in enumerate(links):
        moving[number] = link.parent >= 0 and moving[link.parent]
        moving[number] |= link.index >= 0 and bool(rates[:, link.index].any())
        bodies = parts.get(link.name, ())
        if bodies and moving[number]:
            tree, surface = link_cover(bodies)
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
