"""Where the palm's face is and which way it looks: where an object may come into the open hand."""

import itertools
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from dexgrasp.hand_init.anatomy import Anatomy
from dexgrasp.hand_init.fingers import FingerGuess, span, tip_positions
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Model

TRIES = 48
"""Postures of the joints that do not close, tried for the one in which the fingers oppose each other best."""
STEPS = 12
BEAM, CELL = 0.025, 0.004
"""Radius of the object that is thought to come in, and of what it is made, m."""
ROOM = 0.03
"""The tips should meet this far from the palm, m."""
SNAP = 0.15
"""An axis or diagonal of the root frame is preferred to a better direction that is no more than this better."""
DIAGONALS = [np.array(way) for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if np.abs(way).sum() == 2]


@dataclass
class Palm:
    """Root coordinates, m."""

    origin: Float[ndarray, "3"]
    approach: Float[ndarray, "3"]
    """Unit."""
    center: Float[ndarray, "3"]
    """Where the tips meet."""


def find_palm(anatomy: Anatomy, fingers: list[FingerGuess], guesses: Guesses) -> Palm:
    """Find the palm frame.

    Of candidate directions (axes of the root, of the palm's mesh, the way in which fingers begin to close) one is
    taken along which there is hand behind the place where the tips meet, none before it, and the palm lies behind.
    """
    model = anatomy.model
    _, palm, normals = _surface(model, anatomy.core, {})
    opened, closed, center = _meeting(model, fingers, palm)
    points, _, _ = _surface(model, [], opened)
    middle = palm.mean(axis=0) if len(palm) else _bases(model, fingers).mean(axis=0)
    out = center - middle
    candidates = [("an axis of the root frame", sign * axis) for axis in np.eye(3) for sign in (1, -1)]
    candidates += [("a diagonal of the root frame", _unit(way)) for way in DIAGONALS]
    candidates += [("an axis of the palm's mesh", way) for way in _mesh_axes(palm)]
    start = tip_positions(model, fingers, _mixed(opened, closed, 0.0))
    later = tip_positions(model, fingers, _mixed(opened, closed, 0.05))
    ways = (later - start)[0]
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    alike = max(([w for w in ways if w @ way > 0.8] for way in ways), key=len)
    if len(alike) > len(fingers) / 2:
        candidates.append(("the way in which most fingers begin to close", _unit(np.sum(alike, axis=0))))
    candidates.append(("from the palm's middle to where the tips meet", _unit(out)))
    # Without a palm there is nothing behind by which directions could be told apart.
    seen = points if len(palm) else np.zeros((0, 3))
    scores = np.array([_score(seen, center, middle, way) for _, way in candidates])
    chosen = best = int(scores.argmax())
    for simple in (slice(0, 6), slice(6, 18)):  # designers align frames: axes first, then diagonals
        first = simple.start + int(scores[simple].argmax())
        if scores[first] > scores[best] - SNAP:
            chosen = first
            break
    approach = candidates[chosen][1]
    others = [s for s, (_, way) in zip(scores, candidates, strict=True) if way @ approach < 0.7]
    lead = float(scores[chosen] - max(others, default=0.0))
    origin = _origin(palm, normals, center, approach, middle)
    guesses.add(
        "palm",
        f"the approach direction {np.round(approach, 3).tolist()} is {candidates[chosen][0]}: hand behind the place "
        f"where the tips meet ({np.round(center, 3).tolist()}), none before it (score {scores[chosen]:.2f}, next "
        f"{scores[chosen] - lead:.2f})",
        "likely" if lead > 0.25 else "UNSURE",
    )
    if not len(palm):
        guesses.add("palm", "the palm has no shape: its face is taken at the fingers' first joints", "UNSURE")
    return Palm(origin, approach, center)


def _meeting(
    model: Model, fingers: list[FingerGuess], palm: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """Return an open and a closed posture between which the tips oppose each other, and where they meet.

    There must be room for an object between tips and palm: fists do not count.
    """
    rng = np.random.default_rng(0)
    closing = {joint: rate for finger in fingers for joint, rate in finger.closing.items()}
    idle = [joint for joint in model.free if joint.name not in closing]
    tries = {joint.name: rng.uniform(*span(joint), TRIES) for joint in idle}
    for joint in idle:
        tries[joint.name][0] = np.clip(0.0, *span(joint))
        tries[joint.name][1] = sum(span(joint)) / 2
    ends = {j: span(model.joints[j])[:: 1 if rate > 0 else -1] for j, rate in closing.items()}
    parts = np.linspace(0, 1, STEPS)
    values = {name: np.repeat(v, STEPS) for name, v in tries.items()}
    values |= {j: np.tile(low + (high - low) * parts, TRIES) for j, (low, high) in ends.items()}
    tips = tip_positions(model, fingers, values).reshape(TRIES, STEPS, len(fingers), 3)
    apart = np.linalg.norm(tips[..., :, None, :] - tips[..., None, :, :], axis=-1).mean(axis=(-1, -2))
    moves = np.gradient(tips, axis=1)
    moves /= np.maximum(np.linalg.norm(moves, axis=-1, keepdims=True), 1e-9)
    together = np.linalg.norm(moves.mean(axis=2), axis=-1)  # 0 where the tips oppose each other
    room = np.full(apart.shape, ROOM)
    if len(palm):
        room = np.minimum(cKDTree(palm).query(tips.mean(axis=2).reshape(-1, 3))[0].reshape(apart.shape), ROOM)
    place = np.unravel_index((apart + 0.05 * together - 2 * room).argmin(), apart.shape)
    posture = {name: v[[place[0]]] for name, v in tries.items()}
    opened = posture | {j: np.array([low]) for j, (low, _) in ends.items()}
    closed = posture | {j: np.array([high]) for j, (_, high) in ends.items()}
    return opened, closed, tips[place].mean(axis=0)


def _mixed(a: dict[str, np.ndarray], b: dict[str, np.ndarray], part: float) -> dict[str, np.ndarray]:
    return {name: a[name] + part * (b[name] - a[name]) for name in a}


def _surface(model: Model, palm: list[str], values: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """Return surface points of the whole hand (N, 3) and of the palm with their normals, root coordinates.

    Points are spread by area.
    """
    poses = model.poses(values)
    every, own, normals = [], [np.zeros((0, 3))], [np.zeros((0, 3))]
    for name, link in model.links.items():
        if link.mesh is None:
            continue
        count = int(np.clip(link.mesh.area * 3e5, 50, 20000))
        points, faces = trimesh.sample.sample_surface(link.mesh, count, seed=0)
        turn, shift = poses[name][0, :3, :3], poses[name][0, :3, 3]
        every.append(points @ turn.T + shift)
        if name in palm:
            own.append(every[-1])
            normals.append(link.mesh.face_normals[faces] @ turn.T)
    return np.vstack(every), np.vstack(own), np.vstack(normals)


def _mesh_axes(palm: np.ndarray) -> list[np.ndarray]:
    if len(palm) < 10:
        return []
    try:
        frame = trimesh.bounds.oriented_bounds(palm)[0][:3, :3]
    except Exception:  # a flat palm has no hull
        return []
    return [sign * axis for axis in frame for sign in (1, -1)]


def _score(points: np.ndarray, center: np.ndarray, middle: np.ndarray, way: np.ndarray) -> float:
    """Return how well an object may come in against `way`: 1.5 where all of a beam meets the hand, and only behind.

    A beam of cells; each has hand behind the place where the tips meet, before it, or none.
    """
    offset = points - center
    along = offset @ way
    side = np.linalg.svd(way[None])[2][1:]
    cells = np.round(offset @ side.T / CELL).astype(int)
    inside = np.linalg.norm(cells * CELL, axis=1) < BEAM
    reach = int(BEAM / CELL)
    total = sum(np.hypot(i, j) * CELL < BEAM for i in range(-reach, reach + 1) for j in range(-reach, reach + 1))
    behind, before = (len(np.unique(cells[inside & half], axis=0)) / total for half in (along < 0, along > 5e-3))
    out = center - middle
    straight = float(out @ way) / max(float(np.linalg.norm(out)), 1e-9)
    return float(behind - 2 * before + 0.5 * straight)


def _origin(
    palm: np.ndarray, normals: np.ndarray, center: np.ndarray, approach: np.ndarray, middle: np.ndarray
) -> np.ndarray:
    """Return the point of the palm's face behind where the tips meet."""
    if not len(palm):
        return middle
    facing = normals @ approach > 0.5
    offset = palm - center
    aside = np.linalg.norm(offset - np.outer(offset @ approach, approach), axis=1)
    behind = facing & (offset @ approach < 0)
    near = behind & (aside < BEAM)
    chosen = near if near.sum() > 20 else behind if behind.sum() > 20 else np.ones(len(palm), dtype=bool)
    height = float(np.quantile(palm[chosen] @ approach, 0.8))
    origin = center + (height - center @ approach) * approach
    # By design hands are symmetric about a plane of their frame: small rests are noise.
    rest = np.where(np.abs(origin) < 0.004, 0.0, origin)
    return rest + (height - rest @ approach) * approach


def _bases(model: Model, fingers: list[FingerGuess]) -> np.ndarray:
    poses = model.poses({})
    return np.array([poses[finger.chain.joints[0].child][0, :3, 3] for finger in fingers])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
