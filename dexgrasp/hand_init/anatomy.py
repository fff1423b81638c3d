"""Where in a robot's tree the hand is: palm, root, and the chains that are fingers."""

from dataclasses import dataclass

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Joint, Model

REACH, SPAN = 0.45, 0.3
"""No hand measures more from a finger's first joint to its last, and between the first joints of two fingers, m."""


@dataclass
class Chain:
    """A chain of joints from the palm to a tip."""

    joints: list[Joint]
    """Movable joints, proximal first."""
    links: list[str]
    """Links that the last joint carries rigidly and that the tip may be."""


@dataclass
class Anatomy:
    """A model cut down to the hand, and its parts."""

    model: Model
    palm: list[str]
    """Links of the palm: fixed to each other, the fingers' first joints on them."""
    core: list[str]
    """Those of them from the last branching on, if they have a shape: without mounts and sensors below."""
    chains: list[Chain]


def rigid(model: Model, link: str) -> list[str]:
    """Return a link and the links fixed below it."""
    group = [link]
    for name in group:
        group += [joint.child for joint in model.joints.values() if joint.parent == name and joint.kind == "fixed"]
    return group


def find_hand(model: Model, root: str | None, guesses: Guesses) -> Anatomy:
    """Find palm and fingers; the hand begins at `root`, else where the last branching before the fingers is.

    Raises DexgraspError where there are no fingers, or several hands.
    """
    if root is not None:
        if root not in model.links:
            raise DexgraspError(f"a link of {model.path} as root", repr(root), f"one of {', '.join(model.links)}")
        model = model.cut(root)
    groups = {
        name: rigid(model, name) for name in model.order if name not in model.above or model.above[name].kind != "fixed"
    }
    below = {name: [n for n in groups if n in set(model.below(name)) and n != name] for name in groups}
    tips = {name: _tips(model, groups, below, name) for name in groups}
    branching = [name for name in groups if len(_branches(model, groups, tips, name)) > 1]
    if not branching:
        moving = ", ".join(model.joints) if len(model.joints) < 8 else f"{len(model.free)} movable joints"
        raise DexgraspError(
            f"a hand in {model.path}: a palm with two fingers or more, each on a joint of its own",
            f"no link from which two chains of movable links part ({moving or 'no joints'})",
            "name a file that holds a hand; one moving jaw against a fixed one is none here",
        )
    tops = [name for name in branching if not any(name in below[other] for other in branching)]
    hands = tops if root is not None else [n for n in branching if _hand_sized(model, n, tips[n], groups)]
    hands = [name for name in hands if not any(name in below[other] for other in hands)]
    if not hands:
        raise DexgraspError(
            f"a branching of a hand's size in {model.path}: fingers up to {REACH:g} m long, {SPAN:g} m apart",
            f"only larger ones: {', '.join(groups[name][0] for name in branching)}",
            "if one of these is a hand all the same: root=<its link>; if lengths are in millimetres, scale the model",
        )
    if len(hands) > 1:
        starts = [_start(model, groups[name], _branches(model, groups, tips, name)) for name in hands]
        listed = "; ".join(f"root={s} ({len(tips[n])} fingers)" for s, n in zip(starts, hands, strict=True))
        raise DexgraspError(f"one hand in {model.path}", f"{len(hands)}: {listed}", "add one of these root=...")
    (top,) = hands
    start = root or _start(model, groups[top], _branches(model, groups, tips, top))
    if start != model.root:
        arm = [joint.name for joint in model.path_to(start) if joint.moves]
        guesses.add(
            "root",
            f"the hand begins at link {start!r}: the last that branches before the fingers"
            + (f"; the {len(arm)} joints below it ({arm[0]} .. {arm[-1]}) are the arm's" if arm else ""),
            "likely",
        )
        model = _own_drivers(model, start, guesses).cut(start)
    palm_top = start if start in groups[top] else top
    palm = [name for name in rigid(model, palm_top)]
    chains = [_chain(model, tip, palm) for tip in tips[top]]
    core = rigid(model, _common(model, palm_top, [chain.joints[0] for chain in chains]))
    return Anatomy(model, palm, core if any(model.links[link].solid for link in core) else palm, chains)


def _tips(model: Model, groups: dict[str, list[str]], below: dict[str, list[str]], name: str) -> list[str]:
    """Return the last groups with a shape on every way down from a group; groups without one tell nothing."""
    solid = [n for n in below[name] if any(model.links[link].solid for link in groups[n])]
    return [n for n in solid if not set(below[n]) & set(solid)]


def _branches(model: Model, groups: dict[str, list[str]], tips: dict[str, list[str]], name: str) -> list[Joint]:
    """Return the joints on a group below which there are tips."""
    first = []
    for joint in model.joints.values():
        if joint.moves and joint.parent in groups[name]:
            child = joint.child
            if tips[child] or any(model.links[link].solid for link in groups[child]):
                first.append(joint)
    return first


def _hand_sized(model: Model, top: str, tips: list[str], groups: dict[str, list[str]]) -> bool:
    poses, firsts = model.poses({}), []
    for tip in tips:
        joints = [joint for joint in model.path_to(tip, top) if joint.child not in groups[top]]
        start = next(i for i, joint in enumerate(joints) if joint.moves)
        firsts.append(poses[joints[start].child][0, :3, 3])
        if sum(float(np.linalg.norm(joint.origin[:3, 3])) for joint in joints[start + 1 :]) > REACH:
            return False
    apart = np.linalg.norm(np.array(firsts)[:, None] - np.array(firsts)[None], axis=-1)
    return float(apart.max()) < SPAN


def _start(model: Model, group: list[str], first: list[Joint]) -> str:
    """Return the link at which the hand begins, out of the rigid group that is its palm.

    All of it where nothing moves below; else from the lowest link that has a shape, without that on the arm's joint.
    """
    if group[0] == model.root:
        return group[0]
    way = _up(model, _common(model, group[0], first), group[0])  # up to the group's first
    solid = [link for link in way[:-1] if model.links[link].solid]
    return solid[-1] if solid else way[0]


def _common(model: Model, top: str, joints: list[Joint]) -> str:
    """Return the lowest link on which, or fixed above which, all these joints are; `top` is the highest."""
    common = _up(model, joints[0].parent, top)
    for joint in joints[1:]:
        way = _up(model, joint.parent, top)
        common = [link for link in common if link in way]
    return common[0]


def _up(model: Model, link: str, top: str) -> list[str]:
    way = [link]
    while way[-1] != top:
        way.append(model.above[way[-1]].parent)
    return way


def _own_drivers(model: Model, start: str, guesses: Guesses) -> Model:
    """Let no joint of the hand mimic one that the cut takes away: the first of those that do leads the others."""
    kept = set(model.below(start))
    leaders: dict[str, Joint] = {}
    for joint in [joint for joint in model.joints.values() if joint.parent in kept and joint.mimic is not None]:
        lead = model.driver(joint.name)
        if model.joints[lead.joint].parent in kept or lead.rate == 0:
            continue
        if lead.joint not in leaders:
            leaders[lead.joint] = joint
    for name, leader in leaders.items():
        old = model.driver(leader.name)
        guesses.add(
            "couplings", f"{leader.name} leads the joints that mimic {name}, which is outside the hand", "UNSURE"
        )
        followers = [j for j in model.joints.values() if j.mimic is not None and model.driver(j.name).joint == name]
        told = [(joint, model.driver(joint.name)) for joint in followers if joint is not leader]
        leader.mimic = None
        for joint, new in told:
            assert joint.mimic is not None
            rate = new.rate / old.rate
            joint.mimic.joint, joint.mimic.rate = leader.name, rate
            joint.mimic.offset = new.offset - rate * old.offset
    return model


def _chain(model: Model, tip: str, palm: list[str]) -> Chain:
    joints = [joint for joint in model.path_to(tip) if joint.moves and joint.child not in palm]
    return Chain(joints, rigid(model, tip))
