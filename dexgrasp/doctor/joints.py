"""Joints as the URDF has them: limits, couplings, efforts, order."""

import math
from collections.abc import Iterator
from xml.etree.ElementTree import Element

from dexgrasp.doctor.description import Description
from dexgrasp.doctor.finding import Finding, error, note, warning

FULL_TURN = 2 * math.pi
LONG_SLIDE = 0.5
"""A finger slides no farther, m."""
OVERSHOOT, FAR_OVERSHOOT = 0.02, 0.25
"""How far a coupled joint may leave its own limits, as a part of its range."""
PLACEHOLDER = 100.0
"""No finger joint has this torque (N m); 1000 and 1e6 are what exporters write where nobody said."""


def limits_are_there(hand: Description) -> Iterator[Finding]:
    """Every joint that moves has finite limits in order, in radians or metres."""
    for name in hand.movable:
        joint = hand.joints[name]
        if hand.mimic(name) is not None:
            continue
        lower, upper = _limits(hand, name)
        if joint.get("type") == "continuous" and hand.replaced("limits", name) is None:
            yield warning(
                name,
                "is continuous; one turn, -3.14 to 3.14 rad, is taken",
                "search and bins cover a whole turn, and closing runs until the far end",
                "give the real limits under `limits` in the hand's YAML",
            )
        elif math.isnan(lower) or math.isnan(upper):
            yield error(
                name,
                "has no limits",
                "search, labels and closing need to know where the joint ends; the hand is refused",
                "add <limit lower upper effort velocity/> to the URDF, or `limits` to the hand's YAML",
            )
        elif lower > upper:
            yield error(
                name,
                f"limits are inverted: lower {lower:g}, upper {upper:g}",
                "no posture lies between them; the hand is refused",
                "exchange them; if the axis was turned round, negate both as well",
            )
        elif lower == upper:
            yield warning(
                name,
                f"cannot move: both limits are {lower:g}",
                "it counts as an independent joint that is always the same; a finger that it closes cannot close",
                'write type="fixed", or its real limits',
            )
        else:
            yield from _size(name, joint, lower, upper)


def couplings_stay_within_limits(hand: Description) -> Iterator[Finding]:
    """Coupled (mimic) joints follow a joint that exists, move, and keep their own limits while it runs through its."""
    for name in hand.movable:
        told = hand.mimic(name)
        if told is None:
            continue
        leader, multiplier, offset = told
        if leader not in hand.joints or leader == name:
            yield error(
                name,
                f"follows {leader!r}, " + ("itself" if leader == name else "which is no joint here"),
                "the hand is refused",
                "correct its <mimic> tag, or say it under `couplings` in the hand's YAML",
            )
            continue
        if multiplier == 0:
            yield error(name, "follows with multiplier 0", "it never moves", "write the gear ratio, or make it fixed")
        lower, upper = _limits(hand, name)
        low, high = _limits(hand, leader)
        if any(map(math.isnan, (lower, upper, low, high))) or hand.mimic(leader) is not None:
            continue
        ends = sorted((multiplier * low + offset, multiplier * high + offset))
        beyond = max(lower - ends[0], ends[1] - upper)
        span = upper - lower
        if lower < upper and beyond > OVERSHOOT * span:
            tell = error if beyond > FAR_OVERSHOOT * span else warning
            yield tell(
                name,
                f"runs from {ends[0]:.4g} to {ends[1]:.4g} while {leader} runs through its limits, but its own limits "
                f"are {lower:.4g} to {upper:.4g}",
                "the real joint stops before its leader does: closed postures, and contacts, are not the real hand's",
                f"correct multiplier, offset or the limits of {leader} or {name} (`couplings`, `limits` in the YAML)",
            )


def efforts_are_given(hand: Description) -> Iterator[Finding]:
    """Every independent joint has an effort limit above zero that a finger's motor may have."""
    for name in hand.movable:
        if hand.mimic(name) is not None:
            continue
        effort = _effort(hand, name)
        if not 0 < effort < math.inf:
            yield error(
                name,
                "has no effort limit" if math.isnan(effort) else f"effort limit {effort:g}",
                "physics closes the fingers with it: without, nothing can be held; the hand is refused",
                "write tip force times lever arm (N m; N for a slide) in <limit effort=...>, or `efforts` in the YAML",
            )
        elif effort >= PLACEHOLDER and hand.joints[name].get("type") != "prismatic":
            yield warning(
                name,
                f"effort limit {effort:g} N m",
                "looks like a placeholder: lift tests would squeeze as no real finger does",
                "write tip force times lever arm under `efforts` in the hand's YAML",
            )


def joint_order_is_told(hand: Description) -> Iterator[Finding]:
    """The order of independent joints, which is that of the URDF."""
    free = [name for name in hand.movable if hand.mimic(name) is None]
    if free != sorted(free, key=_natural):
        yield note(
            hand.name,
            f"independent joints stand in the URDF's order: {', '.join(free)}",
            "joint vectors are told in it everywhere; drivers and other programs often sort by name or along the tree",
            "match joints by name (`hand.joint_names`), never by position",
        )


def _size(name: str, joint: Element, lower: float, upper: float) -> Iterator[Finding]:
    if joint.get("type") == "prismatic":
        if upper - lower > LONG_SLIDE:
            yield error(
                name,
                f"slides {upper - lower:g} m",
                "no finger does: everything here is in metres",
                "write metres, not millimetres",
            )
    elif max(abs(lower), abs(upper)) > FULL_TURN + 1e-6:
        yield error(
            name,
            f"limits {lower:g} to {upper:g}",
            "more than a turn: everything here is in radians",
            "write radians, not degrees",
        )


def _limits(hand: Description, joint: str) -> tuple[float, float]:
    told = hand.replaced("limits", joint)
    if told is not None:
        return float(told[0]), float(told[1])
    if hand.joints[joint].get("type") == "continuous":
        return -math.pi, math.pi
    tag = hand.joints[joint].find("limit")
    return _number(tag, "lower"), _number(tag, "upper")


def _effort(hand: Description, joint: str) -> float:
    told = hand.replaced("efforts", joint)
    tag = hand.joints[joint].find("limit")
    return float(told) if told is not None else math.nan if tag is None else _number(tag, "effort")


def _number(tag: Element | None, key: str) -> float:
    try:
        return math.nan if tag is None else float(tag.get(key, 0))
    except ValueError:
        return math.nan


def _natural(name: str) -> list[tuple[int, int | str]]:
    """Return a key that sorts finger_2 before finger_10."""
    words = "".join(c if c.isdigit() else f" {c} " for c in name).split()
    return [(0, int(word)) if word.isdigit() else (1, word) for word in words]
