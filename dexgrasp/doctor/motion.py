"""What a loaded hand does when it closes: whether fingers run into each other, face each other, face the palm's way."""

from collections.abc import Iterator
from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.doctor.finding import Finding, error, note, warning
from dexgrasp.doctor.overlap import SelfOverlap
from dexgrasp.doctor.solid import closed_by, drawn
from dexgrasp.geometry import inverse
from dexgrasp.hand import Finger, Hand

DEEP = 2e-3
"""Overlaps at rest that are more than a joint's cover, m."""
STEPS = 20
"""Postures looked at from open to closed."""
EARLY = 0.25
"""Fingers that meet before this part of closing leave no room for an object."""
CROSSED = 0.7
"""Fingertips that come so much nearer on the way (part of their distance when open) pass each other."""
FACING = 0.5
"""A pad faces what lies this much (cosine) in a direction in which it can press."""
ARC = (0.0, 15.0, 30.0, 45.0, 60.0)
"""Directions in which a fingertip presses: from the pad's towards the tip, deg."""
SIDEWAYS, BEHIND = 60.0, 90.0
"""Angle (deg) between approach axis and the way from palm to grasp that is strange, and that is wrong."""


def links_are_apart_when_open(hand: Hand) -> Iterator[Finding]:
    """With the fingers open no link overlaps another but the next."""
    tips = {finger.link for finger in hand.fingers}
    for found in SelfOverlap(hand).at(closed_by(hand, 0.0)[0]):
        both_tips = {found.first, found.second} <= tips
        tell = error if both_tips else warning if found.depth > DEEP and not found.above else note
        yield tell(
            f"{found.first} and {found.second}",
            f"overlap by {found.depth * 1e3:.1f} mm with the fingers open",
            "pairs that overlap at rest are taken for a joint's cover: their collisions are never tested"
            + ("; two fingertips in each other can hold nothing" if both_tips else ""),
            "slim the collision shapes, or correct an <origin>; leave it where the links really meet in a joint",
        )


def fingers_have_room_to_close(hand: Hand) -> Iterator[Finding]:
    """Closing around nothing, fingers run far before they meet each other or the palm."""
    overlap = SelfOverlap(hand)
    known = {(found.first, found.second) for found in overlap.at(closed_by(hand, 0.0)[0])}
    for step in range(1, STEPS + 1):
        part = step / STEPS
        new = [f for f in overlap.at(closed_by(hand, part)[0]) if (f.first, f.second) not in known]
        if new:
            pairs = ", ".join(f"{found.first} and {found.second}" for found in new)
            early = part < EARLY
            yield (warning if early else note)(
                hand.name,
                f"closing around nothing, the first links meet at {part:.0%} of the way: {pairs}",
                "fingers stop each other there" + (": hardly any object fits between" if early else ""),
                "check the closing directions and limits" if early else "nothing, if the real hand does so, too",
            )
            return


def fingers_close_pad_first(hand: Hand) -> Iterator[Finding]:
    """Closing carries each fingertip towards its pad, and nearer to the others."""
    middle = drawn(hand, 64)
    way = torch.stack([_apart(_tips(hand, closed_by(hand, k / STEPS, middle))) for k in range(STEPS + 1)])
    before, after, least = way[0], way[-1], way.min(dim=0).values
    for i, finger in enumerate(hand.fingers):
        rates = _rates(hand, finger)
        if not rates.abs().max():
            continue
        here = hand.fingertips(middle)[:, i]
        step = 1e-5 / rates.abs().max()
        velocity = (hand.fingertips(middle + step * rates)[:, i, :3, 3] - here[:, :3, 3]) / step
        speed = torch.linalg.vector_norm(velocity, dim=-1).clamp(min=1e-9)
        cosine = (-(velocity * here[:, :3, 1]).sum(-1) / speed).mean()
        told = ", ".join(f"{joint}: {rate:+g}" for joint, rate in finger.closing.items())
        if cosine < 0:
            yield error(
                finger.name,
                f"closing ({told}) moves its tip away from the pad, against closing_axis (cosine {cosine:.2f})",
                "the finger opens when it should close, or its pad is told to be on its back: every grasp misses",
                "change the sign of `closing`, or of `closing_axis` if that is given, in the hand's YAML",
            )
        passed = least[i] < CROSSED * before[i] and after[i] < before[i] / CROSSED
        if after[i] > before[i]:
            yield (warning if passed else error)(
                finger.name,
                f"closing ({told}) carries its tip away from the others: {before[i] * 1e3:.0f} mm from them when open, "
                f"{after[i] * 1e3:.0f} mm when closed" + (f", {least[i] * 1e3:.0f} mm on the way" if passed else ""),
                "open and closed are exchanged: the hand would approach with closed fingers and open them"
                + ("; or the tips pass each other, and its range is wider than needed" if passed else ""),
                "change the sign of `closing` in the hand's YAML (1 is towards the upper limit)"
                + (", or narrow `limits`" if passed else ""),
            )


def pads_face_each_other(hand: Hand) -> Iterator[Finding]:
    """Some two fingertips face each other, with room between them for an object."""
    postures = torch.cat([closed_by(hand, k / STEPS, drawn(hand, 64)) for k in range(STEPS + 1)])
    tips = hand.fingertips(postures)
    angles = torch.deg2rad(torch.tensor(ARC, dtype=torch.float64))[:, None, None, None]
    presses = -(angles.cos() * tips[..., :3, 1] + angles.sin() * tips[..., :3, 0])
    centers, widest = tips[..., :3, 3], 0.0
    for i, j in combinations(range(len(hand.fingers)), 2):
        between = centers[:, j] - centers[:, i]
        gap = torch.linalg.vector_norm(between, dim=-1)
        towards = between / gap.clamp(min=1e-9).unsqueeze(-1)
        here, there = ((presses[:, :, k] * sign * towards).sum(-1).amax(0) for k, sign in ((i, 1), (j, -1)))
        facing = (here > FACING) & (there > FACING)
        room = gap - hand.fingers[i].tip_radius - hand.fingers[j].tip_radius
        widest = max(widest, float(room[facing].max()) if facing.any() else 0.0)
    if widest < 0.01:
        yield error(
            hand.name,
            "no two fingertips face each other"
            + (f" with more than {widest * 1e3:.0f} mm between them" if widest else ""),
            "nothing can be held between fingertips",
            "check closing_axis and the sides on which the pads lie; name the thumb among `fingers`; check its limits",
        )


def the_palm_looks_at_the_grasp(hand: Hand) -> Iterator[Finding]:
    """The palm's approach axis points to where the fingertips meet, and its origin lies behind that."""
    tips = _tips(hand, closed_by(hand, 0.5, _middle(hand)))[0]
    goal = (inverse(hand.base_T_palm)[:3, :3] @ tips.mean(dim=0)) + inverse(hand.base_T_palm)[:3, 3]
    length = float(torch.linalg.vector_norm(goal))
    angle = float(torch.rad2deg(torch.acos((goal[2] / max(length, 1e-9)).clamp(-1, 1))))
    if length > 0.01 and angle > SIDEWAYS:
        lies = " ".join(f"{1e3 * value:.0f}" for value in goal.tolist())
        yield (error if angle > BEHIND else warning)(
            "palm",
            f"half closed, the fingertips meet at ({lies}) mm in the palm frame: {angle:.0f} deg off the approach axis",
            "hands approach objects along that axis and back away along it: from there they come "
            + ("with their back" if angle > BEHIND else "sideways"),
            "set `palm: {origin: ..., approach: ...}` in the YAML: on the palm's face, towards where fingertips meet",
        )


def a_hand_is_its_own_side(hand: Hand) -> Iterator[Finding]:
    """A hand that is called left or right is one, by its palm, fingers and thumb."""
    words = " ".join([hand.name, *hand.link_names]).lower().replace("-", "_")
    sides = [
        side for side in ("left", "right") if side in hand.name.lower() or f"{side}_" in words or f"_{side}" in words
    ]
    thumbs = [i for i, finger in enumerate(hand.fingers) if "thumb" in f"{finger.name} {finger.link}".lower()]
    if len(sides) != 1 or len(thumbs) != 1 or len(hand.fingers) < 3:
        return
    poses = hand.fingertips(closed_by(hand, 0.0))[0]
    others = [i for i in range(len(hand.fingers)) if i != thumbs[0]]
    tip = poses[others, :3, 3].mean(dim=0)
    roots = torch.stack([_root(hand, hand.fingers[i]) for i in range(len(hand.fingers))])
    finger_way = tip - roots[others].mean(dim=0)
    # Fingers up, palm to the viewer: the thumb of a right hand is on the right.
    thumb_way = roots[thumbs[0]] - roots[others].mean(dim=0)
    sign = torch.linalg.det(torch.stack([finger_way, hand.base_T_palm[:3, 2], thumb_way]))
    size = torch.linalg.vector_norm(finger_way) * torch.linalg.vector_norm(thumb_way)
    if abs(float(sign)) < 0.1 * float(size):
        return
    is_right = float(sign) > 0
    if is_right != (sides[0] == "right"):
        yield warning(
            hand.name,
            f"is called {sides[0]}, but thumb, fingers and palm are those of a {'right' if is_right else 'left'} hand",
            "a mirrored hand grasps with the wrong side: its grasps do not fit the real one",
            "check the palm's approach axis; take the model of the other side, or mirror joints, axes and meshes alike",
        )


def _tips(hand: Hand, joints: Float[Tensor, "N J"]) -> Float[Tensor, "N F 3"]:
    return hand.fingertips(joints)[..., :3, 3]


def _apart(tips: Float[Tensor, "N F 3"]) -> Float[Tensor, "F"]:
    """Return the mean distance of each tip to the others, m."""
    gaps = torch.linalg.vector_norm(tips.unsqueeze(1) - tips.unsqueeze(2), dim=-1)
    return gaps.sum(-1).mean(dim=0) / max(tips.shape[1] - 1, 1)


def _rates(hand: Hand, finger: Finger) -> Float[Tensor, "J"]:
    return torch.tensor([finger.closing.get(joint, 0.0) for joint in hand.joint_names], dtype=torch.float64)


def _middle(hand: Hand) -> Float[Tensor, "1 J"]:
    return hand.limits.mean(dim=1, keepdim=True).T.clone()


def _root(hand: Hand, finger: Finger) -> Float[Tensor, "3"]:
    """Return where the first joint of a finger's chain stands, base frame, m; the tip's outer joint without a tree."""
    poses = hand.link_poses(closed_by(hand, 0.0))
    link, path = finger.link, []
    records = {record.name: record for record in getattr(hand, "tree", ())}
    names = list(records)
    while link in records:
        path.append(records[link])
        link = names[records[link].parent] if records[link].parent >= 0 else ""
    first = next((record.name for record in reversed(path) if record.joint is not None), finger.link)
    return poses[first][0, :3, 3]
