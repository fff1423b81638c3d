"""Which links of a hand may overlap: those that do so in every posture, which is how they are drawn, no collision."""

import itertools

import numpy as np

from dexgrasp.ball_tree import planes
from dexgrasp.hand_init.fingers import span
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Model

POSTURES = 40
ALWAYS = 0.9
"""Links that overlap in this part of all postures cannot but do so."""
DEEP = 5e-4
"""A corner of one that lies deeper in the other counts, m."""


def find_allowed(model: Model, guesses: Guesses) -> list[tuple[str, str]]:
    """Return pairs of links, no neighbours, that overlap in nearly every posture."""
    rng = np.random.default_rng(0)
    poses = model.poses({joint.name: rng.uniform(*span(joint), POSTURES) for joint in model.free})
    poses = {name: np.broadcast_to(pose, (POSTURES, 4, 4)) for name, pose in poses.items()}
    solid = [name for name in model.order if model.links[name].parts]
    sides = {name: [planes(part) for part in model.links[name].parts] for name in solid}
    corners = {name: np.vstack([part.vertices for part in model.links[name].parts]) for name in solid}
    always, sometimes = [], 0
    for first, second in itertools.combinations(solid, 2):
        if _neighbours(model, first, second):
            continue
        hits = 0
        for k in range(POSTURES):
            first_T_second = np.linalg.inv(poses[first][k]) @ poses[second][k]
            hits += _overlap(corners[second], sides[first], first_T_second) or _overlap(
                corners[first], sides[second], np.linalg.inv(first_T_second)
            )
        if hits >= ALWAYS * POSTURES:
            always.append((first, second))
        sometimes += 0 < hits < ALWAYS * POSTURES
    if always:
        listed = ", ".join(f"{first} and {second}" for first, second in always)
        guesses.add("allowed_contacts", f"overlap in nearly every posture, so they may: {listed}", "likely")
    guesses.add(
        "allowed_contacts",
        f"neighbours, and what overlaps in the open posture, may overlap anyway; {sometimes} other pairs do in some of "
        f"{POSTURES} random postures, which grasps keep clear of",
        "sure",
    )
    return always


def _neighbours(model: Model, first: str, second: str) -> bool:
    """Whether one is the other's parent."""
    ends = {(joint.parent, joint.child) for joint in model.joints.values()}
    return (first, second) in ends or (second, first) in ends


def _overlap(corners: np.ndarray, parts: list[np.ndarray], pose: np.ndarray) -> bool:
    """Whether a corner of one link lies in a part of another; `pose` takes corners to the parts' frame."""
    points = corners @ pose[:3, :3].T + pose[:3, 3]
    return any(bool(((points @ side[:, :3].T - side[:, 3]).max(axis=1) < -DEEP).any()) for side in parts)
