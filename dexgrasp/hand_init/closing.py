"""Which joints close each finger, and which way: the motion that brings the fingertips together."""

import itertools

import numpy as np

from dexgrasp.hand_init.anatomy import Anatomy
from dexgrasp.hand_init.fingers import FingerGuess, middle, span, tip_positions
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Model

PARALLEL = 0.9
"""Cosine between the axes of joints that bend a finger together."""
SAMPLES = 12
"""Postures of the joints that do not close, over which is averaged."""
BY_RANGE = 0.02
"""What a range that lies to one side of zero counts for, m of tip motion."""


def find_closing(anatomy: Anatomy, fingers: list[FingerGuess], guesses: Guesses) -> list[str]:
    """Set `closing` of every finger; return the independent joints that several fingers share without closing."""
    model = anatomy.model
    turns = [_flexion(model, finger) for finger in fingers]
    owners: dict[str, int] = {}
    for turn in turns:  # joints that must be decided together: those of one finger, and fingers that share a joint
        joined = {owners[joint] for joint in turn if joint in owners}
        new = min(joined, default=len(owners))
        owners = {joint: new if group in joined else group for joint, group in owners.items()}
        owners |= dict.fromkeys(turn, new)
    groups = sorted(set(owners.values()))
    rates: dict[str, float] = {}
    for turn in turns:
        for joint, rate in turn.items():
            rates.setdefault(joint, rate)
    base = _base(model, fingers)
    signs, best = _best_signs(model, fingers, owners, groups, rates, base)
    for group in groups:
        flipped = {**signs, group: -signs[group]}
        gap = _cost(model, fingers, owners, flipped, rates, base) - best
        joints = [joint for joint in owners if owners[joint] == group]
        told = float(np.sign(sum(_one_sided(model, joint) * rates[joint] * signs[group] for joint in joints)))
        names = [finger.name for finger, turn in zip(fingers, turns, strict=True) if set(turn) & set(joints)]
        nearer = gap / 2 / len(names)
        reason = (
            f"this way the tips come {nearer * 1e3:.0f} mm nearer to palm and each other, the other way as far apart"
        )
        if told:
            reason += "; the joints' range from zero " + ("says so too" if told > 0 else "says the opposite")
        # Of jaws zero is often closed: a range that says the opposite does not weigh much.
        confidence = "sure" if nearer > 0.01 and told > 0 else "likely" if nearer > 0.03 or not told else "UNSURE"
        confidence = "UNSURE" if nearer < 0.005 else confidence
        for name in names:
            guesses.add(f"fingers.{name}.closing", reason, confidence)  # type: ignore[arg-type]
    for finger, turn in zip(fingers, turns, strict=True):
        finger.closing = {
            joint.name: rates[joint.name] * signs[owners[joint.name]] for joint in model.free if joint.name in turn
        }
        idle = [joint for joint in finger.drivers if joint not in turn]
        if idle:
            guesses.add(
                f"fingers.{finger.name}.closing",
                f"{', '.join(idle)} moves it too, but about another axis than its last joint: not closing",
                "likely",
            )
    closers = set(owners)
    shared = [
        joint.name
        for joint in model.free
        if joint.name not in closers and sum(joint.name in finger.drivers for finger in fingers) > 1
    ]
    if shared:
        guesses.add("shared", f"{', '.join(shared)}: moves several fingers and closes none", "sure")
    return shared


def _flexion(model: Model, finger: FingerGuess) -> dict[str, float]:
    """Return the independent joints that move the tip as its last joint does; +-1 so that all bend the same way.

    A joint that drives several of the chain counts by the uppermost.
    """
    poses = model.poses(middle(model))
    axes = [poses[joint.child][0, :3, :3] @ joint.axis for joint in finger.chain.joints]
    found: dict[str, float] = {}
    for joint, axis in zip(finger.chain.joints, axes, strict=True):
        along = float(axis @ axes[-1])
        lead = model.driver(joint.name)
        if joint.kind == finger.last.kind and abs(along) > PARALLEL and lead.rate:
            found.setdefault(lead.joint, float(np.sign(along * lead.rate)))
    return found


def _best_signs(
    model: Model,
    fingers: list[FingerGuess],
    owners: dict[str, int],
    groups: list[int],
    rates: dict[str, float],
    base: np.ndarray,
) -> tuple[dict[int, float], float]:
    """Return the sign of each group of joints for which the tips come nearest; all are tried up to 7 groups."""

    def cost(signs: dict[int, float]) -> float:
        return _cost(model, fingers, owners, signs, rates, base)

    if len(groups) <= 7:
        tried = [dict(zip(groups, s, strict=True)) for s in itertools.product((1.0, -1.0), repeat=len(groups))]
        costs = [cost(signs) for signs in tried]
        return tried[int(np.argmin(costs))], min(costs)
    signs = dict.fromkeys(groups, 1.0)
    for group in groups * 2:
        signs = min(signs, {**signs, group: -signs[group]}, key=cost)
    return signs, cost(signs)


def _cost(
    model: Model,
    fingers: list[FingerGuess],
    owners: dict[str, int],
    signs: dict[int, float],
    rates: dict[str, float],
    base: np.ndarray,
) -> float:
    """Return by how much the tips part, from open to closed, summed over fingers (m); less is better."""
    rng = np.random.default_rng(0)
    opened = {joint.name: rng.uniform(*span(joint), SAMPLES) for joint in model.free}
    closed = dict(opened)
    cost = 0.0
    for joint, group in owners.items():
        way = rates[joint] * signs[group]
        low, high = span(model.joints[joint])[:: 1 if way > 0 else -1]
        opened[joint], closed[joint] = np.full(SAMPLES, low), np.full(SAMPLES, high)
        cost -= BY_RANGE * _one_sided(model, joint) * way
    before, after = (_apart(tip_positions(model, fingers, values), base) for values in (opened, closed))
    return cost + float((after - before).mean(axis=0).sum())


def _apart(tips: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Return how far each tip is from the palm plus from the other tips in the mean, (N, F)."""
    others = np.linalg.norm(tips[:, :, None] - tips[:, None], axis=-1).sum(axis=-1) / (tips.shape[1] - 1)
    return np.linalg.norm(tips - base, axis=-1) + others


def _base(model: Model, fingers: list[FingerGuess]) -> np.ndarray:
    """Return the middle of the fingers' first joints."""
    poses = model.poses({})
    return np.mean([poses[finger.chain.joints[0].child][0, :3, 3] for finger in fingers], axis=0)


def _one_sided(model: Model, joint: str) -> float:
    """Return 1 where a turning joint's range lies above zero, -1 where below, between where it straddles it."""
    found = model.joints[joint]
    if found.kind != "revolute" or not np.isfinite([found.lower, found.upper]).all():
        return 0.0
    low, high = found.lower, found.upper
    if high - low < 1e-6 or low > 0.05 or high < -0.05:
        return 0.0
    lean = (high + low) / max(abs(high), abs(low))
    return lean if abs(lean) > 0.2 else 0.0
