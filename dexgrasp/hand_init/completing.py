"""What a model leaves out or has wrong of its joints and masses: ranges, efforts, inertias."""

import numpy as np
import trimesh

from dexgrasp.hand_init.anatomy import Anatomy
from dexgrasp.hand_init.fingers import WIDEST, FingerGuess, group_mesh, middle, span, tip_positions
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Inertia, Joint, Model, motion

OPEN = 0.04
"""A jaw without limits that is closed at zero opens so far, m."""
BEND = 1.2
"""A finger's joint without limits bends at least this far, rad."""
TIP_FORCE = 15.0
"""What a finger presses with where the model does not say, N."""
STRONGEST, STRONG = 1000.0, 60.0
"""Tip forces (N) that no hand has, and that few have."""
SPREAD = 2.0
"""No body's radius of gyration is so many times its length."""
DENSITY = 1200.0
"""Of a link without a mass: plastic with some metal, kg/m3."""


def order_ranges(model: Model, guesses: Guesses) -> None:
    """Put right limits that stand the wrong way round; forget those that are none."""
    for joint in model.joints.values():
        if not joint.moves:
            continue
        if joint.lower > joint.upper:
            joint.lower, joint.upper = joint.upper, joint.lower
            guesses.add("limits", f"{joint.name}: lower was above upper; exchanged", "UNSURE")
        if not np.isfinite(joint.upper - joint.lower) or joint.upper - joint.lower < 1e-9:
            joint.lower = joint.upper = np.nan


def fix_idle(model: Model, fingers: list[FingerGuess], guesses: Guesses) -> None:
    """Fix joints that move no finger, with those that follow them, where they stand at zero or the limit next to it."""
    used = {driver for finger in fingers for driver in finger.drivers}
    idle = [joint for joint in model.free if joint.name not in used]
    values = {joint.name: np.array([np.clip(0.0, *span(joint))]) for joint in idle}
    leads = {joint.name: model.driver(joint.name) for joint in model.joints.values() if joint.moves}
    for name, lead in leads.items():
        if lead.joint in values:
            joint = model.joints[name]
            joint.origin = joint.origin @ motion(joint, lead.rate * values[lead.joint] + lead.offset)[0]
            joint.kind, joint.mimic = "fixed", None
    if idle:
        guesses.add("joints", f"{', '.join(joint.name for joint in idle)}: moves no finger; fixed", "likely")


def complete_ranges(anatomy: Anatomy, fingers: list[FingerGuess], guesses: Guesses) -> None:
    """Give every joint a finite range: a closing joint from open to closed, another one turn."""
    model = anatomy.model
    closing = {joint: rate for finger in fingers for joint, rate in finger.closing.items()}
    for joint in model.free:
        known = np.isfinite(joint.upper - joint.lower)
        if known and (joint.name not in closing or joint.upper - joint.lower < WIDEST[joint.kind]):
            continue
        if joint.name not in closing:
            half = np.pi if joint.kind == "revolute" else 0.05
            joint.lower, joint.upper = -half, half
            guesses.add("limits", f"{joint.name} has none: {-half:.3g} to {half:.3g} was taken", "UNSURE")
            continue
        low, high = _closing_range(model, fingers, joint, closing[joint.name])
        reason = "has none" if not known else f"{joint.lower:.3g} to {joint.upper:.3g} is no finger's range"
        joint.lower, joint.upper = low, high
        guesses.add("limits", f"{joint.name}: {reason}; {low:.3g} to {high:.3g} was taken", "UNSURE")
    for joint in model.joints.values():
        if joint.moves and joint.mimic is not None:
            _fit_follower(model, joint, guesses)


def _fit_follower(model: Model, joint: Joint, guesses: Guesses) -> None:
    """Let a leader stop where the first joint that follows it does; a follower without a range gets its leader's."""
    follow = model.driver(joint.name)
    lead = model.joints[follow.joint]
    ends = sorted(follow.rate * value + follow.offset for value in (lead.lower, lead.upper))
    if not np.isfinite(joint.upper - joint.lower) or not follow.rate:
        joint.lower, joint.upper = ends
        return
    over = max(ends[1] - joint.upper, joint.lower - ends[0])
    if over < 1e-3:
        return
    stops = sorted((value - follow.offset) / follow.rate for value in (joint.lower, joint.upper))
    low, high = max(lead.lower, stops[0]), min(lead.upper, stops[1])
    unit = "rad" if joint.kind == "revolute" else "m"
    if high - low > 0.6 * (lead.upper - lead.lower):
        guesses.add(
            "limits",
            f"{lead.name} goes from {low:.4g} to {high:.4g}, not from {lead.lower:.4g} to {lead.upper:.4g}: there "
            f"{joint.name}, which follows it, has its own limits",
            "likely",
        )
        lead.lower, lead.upper = low, high
    else:
        joint.lower, joint.upper = min(ends[0], joint.lower), max(ends[1], joint.upper)
        guesses.add(
            "limits",
            f"{joint.name} has {over:.3g} {unit} less than it needs to follow {lead.name}: taken wider; are rate and "
            "offset right?",
            "UNSURE",
        )


def complete_efforts(model: Model, fingers: list[FingerGuess], guesses: Guesses) -> None:
    """Give every independent joint an effort; say where the given one is not the real hand's."""
    values = middle(model)
    poses, tips = model.poses(values), tip_positions(model, fingers, values)[0]
    levers = {joint.name: _lever(model, fingers, joint, poses, tips) for joint in model.free}
    forces = {joint.name: joint.effort / levers[joint.name] for joint in model.free}
    given = [force for force in forces.values() if np.isfinite(force) and force > 0]
    placeholders = bool(given) and float(np.median(given)) > STRONGEST
    made, strong = [], []
    for joint in model.free:
        force = forces[joint.name]
        if np.isfinite(force) and force > 0 and not placeholders:
            strong += [f"{joint.name} {force:.0f}"] if force > STRONG else []
            continue
        joint.effort = float(f"{TIP_FORCE * levers[joint.name]:.2g}")
        made.append(f"{joint.name} {joint.effort:g}")
    if made:
        why = f"given ones press with {np.median(given):.0f} N" if placeholders else "not given"
        text = f"{why}: {TIP_FORCE:g} N at the tip taken, that is, in N m or N, {', '.join(made)}"
        guesses.add("efforts", text, "UNSURE")
    if strong:
        text = f"many N at the tip, if taken at their word: {', '.join(strong)}: are these the real hand's?"
        guesses.add("efforts", text, "UNSURE")


def complete_inertias(model: Model, guesses: Guesses) -> None:
    """Give links with a shape a mass, and mend inertias that no body has."""
    for link in model.links.values():
        found = link.inertia
        reason = "none"
        if found is not None and found.mass > 0 and np.isfinite(found.mass):
            moments = np.linalg.eigvalsh(found.moments)
            real = moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * 1.01
            length = np.inf if link.mesh is None else float(link.mesh.extents.max())
            if real and moments[2] <= found.mass * (SPREAD * length) ** 2:
                continue
            reason = f"principal moments {np.array2string(moments, precision=2)} kg m2, which no body has"
        elif found is not None and not link.solid:
            link.inertia = None
            continue
        hull = None if link.mesh is None else _hull(link.mesh)
        if hull is None:
            link.inertia = None
            continue
        mass = found.mass if found is not None and found.mass > 0 else hull.volume * DENSITY
        hull.density = mass / hull.volume
        link.inertia = Inertia(mass, np.array(hull.center_mass), np.array(hull.moment_inertia))
        guesses.add("inertias", f"{link.name}: {reason}; that of its hull of {mass * 1e3:.0f} g was taken", "likely")


def _hull(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    try:
        hull = mesh.convex_hull
    except Exception:  # flat: no hull
        return None
    return hull if hull.volume > 1e-10 else None


def _closing_range(model: Model, fingers: list[FingerGuess], joint: Joint, rate: float) -> tuple[float, float]:
    """Return lower and upper end between which a joint without limits closes, the others in their middle.

    Zero is taken to be open, as usual, unless the tips are together there.
    """
    if joint.kind == "prismatic":
        gap = _gap(model, fingers, joint, rate)
        ends = (0.0, gap / 2) if gap > 0.004 else (-OPEN, max(gap, 0.0) / 2)
        low, high = sorted((rate * ends[0], rate * ends[1]))
        return round(low, 4), round(high, 4)
    width = np.pi / 2
    values = np.linspace(-width, width, 61)
    rest = {name: np.repeat(value, 61) for name, value in middle(model).items()}
    tips = tip_positions(model, fingers, {**rest, joint.name: rate * values})
    own = [i for i, finger in enumerate(fingers) if joint.name in finger.closing]
    others = [i for i in range(len(fingers)) if i not in own] or own
    apart = np.linalg.norm(tips[:, own, None] - tips[:, None, others], axis=-1).mean(axis=(1, 2))
    nearest = float(values[apart.argmin()])
    # A finger may bend beyond the place where tips meet, round an object.
    start, stop = (0.0, max(nearest, BEND)) if nearest > 0.15 else (-0.6 * width, max(nearest, 0.0))
    low, high = sorted((rate * start, rate * stop))
    return round(low, 4), round(high, 4)


def _gap(model: Model, fingers: list[FingerGuess], joint: Joint, rate: float) -> float:
    """Return how far jaws are apart along a slide at zero, m."""
    poses = model.poses({})
    fronts: list[list[float]] = [[], []]
    way = poses[joint.child][0, :3, :3] @ joint.axis * rate
    moved = set(model.below(joint.child))
    for finger in fingers:
        mesh = group_mesh(model, finger.chain)
        if mesh is not None:
            pose = poses[finger.last.child][0]
            along = (mesh.vertices @ pose[:3, :3].T + pose[:3, 3]) @ way
            other = finger.last.child not in moved
            fronts[other].append(float(along.min() if other else along.max()))
    return min(fronts[1]) - max(fronts[0]) if all(fronts) else 0.0


def _lever(
    model: Model, fingers: list[FingerGuess], joint: Joint, poses: dict[str, np.ndarray], tips: np.ndarray
) -> float:
    """Return the largest distance of a tip that a joint moves from its axis (m); 1 for a slide."""
    if joint.kind == "prismatic":
        return 1.0
    pose = poses[joint.child][0]
    axis = pose[:3, :3] @ joint.axis
    arms = [tip - pose[:3, 3] for tip, finger in zip(tips, fingers, strict=True) if joint.name in finger.drivers]
    return max([float(np.linalg.norm(np.cross(axis, arm))) for arm in arms] + [0.02])
