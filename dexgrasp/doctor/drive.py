"""What the joints of a loaded hand are good for: each moves a finger, and fingertips press as fingers do."""

from collections.abc import Iterator

import torch

from dexgrasp.doctor.finding import Finding, error, warning
from dexgrasp.doctor.solid import closed_by
from dexgrasp.hand import Hand

STRONG = 300.0
"""No fingertip presses so hard, N."""
LIGHTEST, USUAL = 0.05, 0.25
"""Masses (kg) of objects in `lift-v1`: the least, and an ordinary one's."""
FRICTION, GRAVITY = 0.6, 9.81
STEP = 1e-5
REAL = "write the real efforts (tip force times lever arm, N m; N for a slide), in the URDF or under `efforts`"


def fingers_are_strong_enough(hand: Hand) -> Iterator[Finding]:
    """Fingertips press with forces that hold an object and that a hand may have."""
    middle = closed_by(hand, 0.5, hand.limits.mean(dim=1, keepdim=True).T.clone())
    forces = []
    for i, finger in enumerate(hand.fingers):
        force = float("inf")
        for joint, rate in finger.closing.items():
            rates = torch.zeros_like(middle)
            rates[0, hand.joint_names.index(joint)] = rate
            moved = hand.fingertips(middle + STEP * rates)[0, i] - hand.fingertips(middle)[0, i]
            lever = torch.linalg.vector_norm(moved[:3, 3]) / STEP
            force = min(force, float(hand.efforts[hand.joint_names.index(joint)] / lever.clamp(min=1e-6)))
        forces.append(force)
    if not forces or not max(forces) < float("inf"):
        return
    told = ", ".join(f"{finger.name} {force:.3g} N" for finger, force in zip(hand.fingers, forces, strict=True))
    lifts = FRICTION * sum(sorted(forces)[-2:]) / GRAVITY
    if lifts < USUAL:
        yield (error if lifts < LIGHTEST else warning)(
            hand.name,
            f"two fingertips hold {lifts * 1e3:.0f} g at most by friction {FRICTION} (forces: {told})",
            f"objects of lift-v1 weigh {LIGHTEST * 1e3:.0f} g to 1 kg: most would slip",
            REAL,
        )
    for finger, force in zip(hand.fingers, forces, strict=True):
        if force > STRONG:
            yield warning(
                finger.name,
                f"its tip presses with up to {force:.3g} N",
                "hands press with 2 to 200 N: lift tests would squeeze as no real finger does",
                REAL,
            )


def every_joint_has_a_use(hand: Hand) -> Iterator[Finding]:
    """Every independent joint moves some finger, and every finger has a joint of its own to close it."""
    used = {joint for finger in hand.fingers for joint in finger.chain}
    for joint in hand.joint_names:
        if joint not in used:
            yield warning(
                joint,
                "moves no finger",
                "search and network spend effort on it, and it changes no grasp",
                "make it fixed in the URDF, name the finger that it moves, or cut the arm off by `root`",
            )
    low, high = hand.limits.T
    for finger in hand.fingers:
        if not any(high[hand.joint_names.index(j)] > low[hand.joint_names.index(j)] for j in finger.closing):
            yield error(
                finger.name, "none of its closing joints can move", "it touches nothing", "correct limits or `closing`"
            )
