"""How a grasp is carried out: where the hand waits before it, and from which side it comes."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.geometry import inverse, rotate
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand


def pregrasp(
    hand: Hand, grasps: Grasps, retreat: float = 0.10, opening: float = 0.35
) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
    """Return frame_T_base and joints from which a straight line leads to each grasp.

    The base stands back by `retreat` (m) against the palm's approach direction; every joint that closes a finger is
    opened by `opening` (rad, or m where prismatic) as far as its limit allows. Other joints, and fingers that do not
    touch, are as in the grasp.
    """
    back = torch.eye(4, dtype=grasps.pose.dtype, device=grasps.pose.device)
    back[2, 3] = -retreat
    base_T_palm = hand.base_T_palm.to(grasps.pose)
    pose = grasps.pose @ base_T_palm @ back @ inverse(base_T_palm)
    return pose, hand.clamp(grasps.joints - opening * closing_directions(hand, grasps.touching).to(grasps.joints))


def opened(
    hand: Hand, joints: Float[Tensor, "N J"], most: float = math.inf, touching: Bool[Tensor, "N F"] | None = None
) -> Float[Tensor, "N J"]:
    """Return postures with every finger opened: back along its closing motion until a joint is at its limit.

    Or until it has opened by `most` (times its rates, rad or m). Closing from there leads through `joints` again. Of
    hands not all of whose fingers are `touching`, the others stay.
    """
    result, done = joints.clone(), set[str]()
    for number, finger in enumerate(hand.fingers):
        own = {joint: rate for joint, rate in finger.closing.items() if joint not in done}
        done |= set(own)
        if not own:
            continue
        places = hand.joint_index(tuple(own))
        rates = torch.tensor(list(own.values()), dtype=joints.dtype, device=joints.device)
        low, high = hand.limits[places].T.to(joints)
        way = ((result[:, places] - torch.where(rates > 0, low, high)) / rates).min(dim=1, keepdim=True).values
        way = way.clamp(max=most) if touching is None else way.clamp(max=most) * touching[:, number : number + 1]
        result[:, places] = result[:, places] - way * rates
    return result


def closing_direction(hand: Hand) -> Float[Tensor, "J"]:
    """Return, per independent joint, +1 or -1 where moving that way closes fingers, 0 where it closes none."""
    direction = torch.zeros(len(hand.joint_names), dtype=torch.float64)
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            direction[hand.joint_names.index(joint)] = (rate > 0) - (rate < 0)
    return direction


def closing_directions(hand: Hand, touching: Bool[Tensor, "N F"]) -> Float[Tensor, "N J"]:
    """Return `closing_direction` for each of N grasps: 0, too, where a joint closes only fingers that do not touch."""
    moves = torch.tensor([[joint in finger.closing for joint in hand.joint_names] for finger in hand.fingers])
    moved = (touching.to(moves.device).unsqueeze(-1) & moves).any(dim=1)
    return torch.where(moved, closing_direction(hand), 0.0)


def tilted(hand: Hand, grasps: Grasps, max_tilt: float | None) -> Bool[Tensor, "N"]:
    """Tell which grasps (z up) approach more than `max_tilt` degrees off straight down; none where it is None."""
    if max_tilt is None:
        return torch.zeros(len(grasps), dtype=torch.bool)
    approach = hand.base_T_palm[:3, 2].to(grasps.pose).expand(len(grasps), 3)
    return -rotate(grasps.pose, approach)[:, 2] < math.cos(math.radians(max_tilt))
