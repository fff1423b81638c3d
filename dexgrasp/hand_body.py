"""A hand as arrays for compiled code: kinematic tree, balls, convex parts, and how its fingers close."""

from typing import NamedTuple

import numpy as np
from numba import njit

from dexgrasp.ball_tree import inscribed_tree, planes
from dexgrasp.cover import Cover
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.hand_cover import hand_cover
from dexgrasp.urdf import UrdfHand

TIP_TOLERANCE = 1e-4
"""How closely balls follow the distal links, m."""
TOLERANCE = 3e-4
"""How closely balls follow all other links, m."""


class HandBody(NamedTuple):
    """L links, M full joints, J independent joints, B balls, P convex parts, F fingers. Metres, radians."""

    parents: np.ndarray
    """(L,) parent link, before its children; -1 for the base."""
    kinds: np.ndarray
    """(L,) 0 fixed, 1 revolute, 2 prismatic."""
    placements: np.ndarray
    """(L, 3, 4) parent_T_joint."""
    axes: np.ndarray
    """(L, 3) joint axis."""
    drives: np.ndarray
    """(L,) full joint that moves the link; -1 where fixed."""
    motions: np.ndarray
    """(L, 18) parent, kind, drive, axis and placement again, in one array: what `place_link` reads."""
    coupling: np.ndarray
    """(M, J) full = coupling joints + offset."""
    offset: np.ndarray
    """(M,)."""
    limits: np.ndarray
    """(M, 2) of all joints."""
    joint_limits: np.ndarray
    """(J, 2) of the independent joints."""
    leaders: np.ndarray
    """(J,) the full joint that is each independent one."""
    balls: np.ndarray
    """(B, 4) centre in the link's frame, radius."""
    children: np.ndarray
    """(B, 2); -1 for a leaf, whose ball touches the link's surface from inside."""
    ball_links: np.ndarray
    """(B,) the link of each ball."""
    roots: np.ndarray
    """(L,) root of each link's tree; -1 without collision geometry."""
    parts: np.ndarray
    """(P + 1,) first plane of each convex part."""
    part_links: np.ndarray
    """(P,)."""
    part_balls: np.ndarray
    """(P, 4) bounding ball of each part."""
    planes: np.ndarray
    """(K, 4) normal . x <= offset inside."""
    vertices: np.ndarray
    """(V, 3) corners of all parts."""
    vertex_links: np.ndarray
    """(V,)."""
    rates: np.ndarray
    """(F, J) joint velocities that close each finger, per unit of its closing parameter."""
    cover: Cover
    """Balls that hold the whole surface of the links that fingers move: what closing looks at."""
    tip_links: np.ndarray
    """(F,) distal links."""
    tips: np.ndarray
    """(F, 7) fingertip centre, closing axis, radius, in the distal link."""


def hand_body(hand: Hand, coarseness: float = 1.0) -> HandBody:
    """Compile a hand; balls follow its surface `coarseness` times less closely. The result is kept with it."""
    if not isinstance(hand, UrdfHand):
        raise DexgraspError("a UrdfHand", type(hand).__name__, "describe the hand by a URDF")
    made: dict[float, HandBody] = hand.__dict__.setdefault("_bodies", {})
    if coarseness not in made:
        made[coarseness] = _compile(hand, coarseness)
    return made[coarseness]


def _compile(hand: UrdfHand, coarseness: float) -> HandBody:
    names = [record.name for record in hand.tree]
    matrix, offset = (part.numpy() for part in hand.coupling)
    # Coupled joints go where their drivers take them, and to their own limits after breakaway.
    ends = np.sort(hand.full_joints(hand.limits.T).numpy().T, axis=1)
    own = np.stack([hand.model.lowerPositionLimit, hand.model.upperPositionLimit], axis=1)
    limits = np.stack([np.minimum(ends[:, 0], own[:, 0]), np.maximum(ends[:, 1], own[:, 1])], axis=1)
    rates = np.array([[finger.closing.get(joint, 0.0) for joint in hand.joint_names] for finger in hand.fingers])
    balls, children, roots, links = [], [], np.full(len(names), -1), []
    count = 0
    for link, name in enumerate(names):
        if not hand.collisions.get(name):
            continue
        tolerance = TIP_TOLERANCE if any(finger.link == name for finger in hand.fingers) else TOLERANCE
        nodes, below = inscribed_tree(hand.collisions[name], coarseness * tolerance)
        roots[link] = count
        balls.append(nodes)
        children.append(np.where(below < 0, -1, below + count))
        links.append(np.full(len(nodes), link))
        count += len(nodes)
    bodies = [(link, part) for link, name in enumerate(names) for part in hand.collisions.get(name, ())]
    sides = [planes(part) for _, part in bodies]
    centers = [part.bounds.mean(axis=0) for _, part in bodies]
    reach = [np.linalg.norm(p.vertices - c, axis=1).max() for (_, p), c in zip(bodies, centers, strict=True)]
    parents = np.array([record.parent for record in hand.tree])
    kinds = np.array([("fixed", "revolute", "prismatic").index(record.kind) for record in hand.tree])
    placements = np.ascontiguousarray([record.parent_T_joint[:3] for record in hand.tree])
    axes = np.array([record.axis for record in hand.tree])
    drives = np.array([record.index for record in hand.tree])
    return HandBody(
        parents=parents,
        kinds=kinds,
        placements=placements,
        axes=axes,
        drives=drives,
        motions=np.column_stack([parents, kinds, drives, axes, placements.reshape(-1, 12)]),
        coupling=np.ascontiguousarray(matrix),
        offset=offset,
        limits=limits,
        joint_limits=hand.limits.numpy(),
        leaders=np.array([hand.full_joint_names.index(joint) for joint in hand.joint_names]),
        balls=np.concatenate(balls),
        children=np.concatenate(children),
        ball_links=np.concatenate(links),
        roots=roots,
        parts=np.cumsum([0, *map(len, sides)]),
        part_links=np.array([link for link, _ in bodies]),
        part_balls=np.column_stack([centers, reach]),
        planes=np.concatenate(sides),
        vertices=np.concatenate([part.vertices for _, part in bodies]),
        vertex_links=np.concatenate([np.full(len(part.vertices), link) for link, part in bodies]),
        rates=rates,
        cover=hand_cover(hand.tree, hand.collisions, limits, rates @ matrix.T),
        tip_links=np.array([names.index(finger.link) for finger in hand.fingers]),
        tips=np.array([[*f.tip_center.tolist(), *f.closing_axis.tolist(), f.tip_radius] for f in hand.fingers]),
    )


@njit(cache=True, error_model="numpy")
def place_link(motions: np.ndarray, link: int, full: np.ndarray, base: np.ndarray, poses: np.ndarray) -> None:
    """Write frame_T_link (3, 4) of one link from its parent's; `base` is frame_T_base."""
    parent, kind = int(motions[link, 0]), int(motions[link, 1])
    s, v, q = 0.0, 0.0, 0.0
    if kind:
        q = full[int(motions[link, 2])]
        if kind == 1:
            s, v = np.sin(q), 1 - np.cos(q)
    x, y, z = motions[link, 3], motions[link, 4], motions[link, 5]
    c = 1 - v
    for i in range(3):
        if parent < 0:
            u0, u1, u2, u3 = base[i, 0], base[i, 1], base[i, 2], base[i, 3]
        else:
            u0, u1, u2, u3 = poses[parent, i, 0], poses[parent, i, 1], poses[parent, i, 2], poses[parent, i, 3]
        a = u0 * motions[link, 6] + u1 * motions[link, 10] + u2 * motions[link, 14]
        b = u0 * motions[link, 7] + u1 * motions[link, 11] + u2 * motions[link, 15]
        d = u0 * motions[link, 8] + u1 * motions[link, 12] + u2 * motions[link, 16]
        t = u0 * motions[link, 9] + u1 * motions[link, 13] + u2 * motions[link, 17] + u3
        if kind == 2:
            t += q * (a * x + b * y + d * z)
        poses[link, i, 0] = a * (c + x * x * v) + b * (y * x * v + z * s) + d * (z * x * v - y * s)
        poses[link, i, 1] = a * (x * y * v - z * s) + b * (c + y * y * v) + d * (z * y * v + x * s)
        poses[link, i, 2] = a * (x * z * v + y * s) + b * (y * z * v - x * s) + d * (c + z * z * v)
        poses[link, i, 3] = t


@njit(cache=True)
def place_links(body: HandBody, joints: np.ndarray, base: np.ndarray, full: np.ndarray, poses: np.ndarray) -> None:
    """Write the full joints (M,) and frame_T_link (L, 3, 4) of all links for independent joints (J,)."""
    for m in range(len(full)):
        full[m] = body.offset[m]
        for j in range(len(joints)):
            full[m] += body.coupling[m, j] * joints[j]
    motions = body.motions
    for link in range(len(motions)):
        place_link(motions, link, full, base, poses)


@njit(cache=True)
def carry(poses: np.ndarray, link: int, points: np.ndarray, k: int) -> tuple[float, float, float]:
    """Return point k (its first three numbers) of a link's frame in the outer frame."""
    x, y, z = points[k, 0], points[k, 1], points[k, 2]
    return (
        poses[link, 0, 0] * x + poses[link, 0, 1] * y + poses[link, 0, 2] * z + poses[link, 0, 3],
        poses[link, 1, 0] * x + poses[link, 1, 1] * y + poses[link, 1, 2] * z + poses[link, 1, 3],
        poses[link, 2, 0] * x + poses[link, 2, 1] * y + poses[link, 2, 2] * z + poses[link, 2, 3],
    )
