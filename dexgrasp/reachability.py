"""Which grasps an arm can carry out: inverse kinematics along the way to each, and the arm clear of what was seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.arm import Arm
from dexgrasp.arm_collision import ArmBody, Points
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.inverse_kinematics import descend, solutions
from dexgrasp.motion import TrajectorySettings, lift_direction

STRIDE = 0.02
"""Places along the straight parts of the way are at most so far apart, m."""
JUMP = 0.5
"""A joint that moves by more between two of them has changed to another solution, rad (or m)."""


@dataclass(frozen=True)
class ReachSettings:
    """How hard a way is looked for."""

    seeds: int = 8
    """Postures from which each grasp's solutions are looked for."""
    rounds: int = 4
    """So many times, where none was found."""
    margin: float = 0.01
    """What the arm keeps clear of points and table, m; Coal's cubes add up to 5 mm."""


@dataclass(frozen=True, eq=False)
class Reach:
    """N grasps on an arm of A joints, along W places: pre-grasp, ..., grasp, ..., lifted."""

    joint_names: tuple[str, ...]
    reachable: Bool[Tensor, "N"]
    reason: tuple[str, ...]
    """In words; empty where reachable."""
    joints: Float[Tensor, "N W A"]
    """The arm's joints along the way, rad (m where prismatic); NaN where not reachable."""
    pose: Float[Tensor, "N W 4 4"]
    """arm_T_flange along the way, m."""
    grasp: int
    """The place that is the grasp itself; the first is the pre-grasp, the last is lifted."""
    order: Int[Tensor, "N"]
    """Reachable grasps first, else as they came: ``grasps[reach.order]`` is the new ranking."""

    def as_dict(self, row: int) -> dict[str, Any]:
        """Return what is to be told of one grasp as plain values."""
        good = bool(self.reachable[row])
        told: dict[str, Any] = {"reachable": good, "reason": self.reason[row], "joint_names": list(self.joint_names)}
        if good:
            ends = {"pregrasp": 0, "grasp": self.grasp, "lifted": -1}
            told |= {name: self.joints[row, at].tolist() for name, at in ends.items()}
            told |= {"way": self.joints[row].tolist()}
        return told


def reachable(
    arm: Arm,
    hand: Hand,
    grasps: Grasps,
    cloud: Float[Tensor, "P 3"] | None,
    camera_T_arm: Float[Tensor, "4 4"],
    *,
    table_T_camera: Float[Tensor, "4 4"] | None = None,
    up: Sequence[float] | None = None,
    motion: TrajectorySettings | None = None,
    settings: ReachSettings | None = None,
    seed: int = 0,
) -> Reach:
    """Tell which grasps an arm reaches, and how.

    A grasp is reachable where one solution of the grasp can be followed without a jump back to the pre-grasp and on
    to the end of the lift, within joint limits, and the arm on it stays clear of the cloud, the table and itself.
    Solutions are tried from that nearest to the home posture on. How the arm comes to the pre-grasp is not planned.

    Args:
        arm: `load_arm("panda")` or one's own; its `flange_T_hand` says how the hand is mounted.
        hand: the grasps' hand.
        grasps: N grasps in the frame of `cloud` ("camera" in what follows; any other will do).
        cloud: what was seen, m, without the arm itself; more columns than three are ignored. None: not looked at.
        camera_T_arm: the arm's base in that frame, m.
        table_T_camera: the table (`find_table`): surface at z = 0, z up. None: not looked at.
        up: direction of the lift in the frame of `grasps`; None: the table's z, or without it back the way it came.
        motion: the way, as for `trajectory`.
        settings: how hard it is tried.
        seed: of the seeds that are drawn.
    """
    motion, settings = motion or TrajectorySettings(), settings or ReachSettings()
    camera_T_arm = _rigid(camera_T_arm)
    if up is None and table_T_camera is not None:
        up = table_T_camera[2, :3].tolist()
    grasps = grasps.to("cpu", torch.float64)
    goals, middle = _way(arm, hand, grasps, inverse(camera_T_arm), motion, up)
    count, places = goals.shape[:2]
    finite = goals.flatten(1).isfinite().all(dim=1)
    goals = torch.where(finite[:, None, None, None], goals, torch.eye(4, dtype=torch.float64))
    found, good = solutions(arm, goals[:, middle], settings.seeds, settings.rounds, seed)
    good &= finite[:, None]
    ways, passes = _followed(arm, goals, found, good, middle)
    points = None if cloud is None else Points(torch.as_tensor(cloud)[:, :3], inverse(camera_T_arm), 1.5 * arm.reach)
    arm_T_table = None if table_T_camera is None else inverse(table_T_camera.double() @ camera_T_arm)
    joints = torch.full((count, places, len(arm.joint_names)), torch.nan, dtype=torch.float64)
    reasons = []
    _, opened = pregrasp(hand, grasps, 0.0, motion.opening)
    body = ArmBody(arm, hand) if bool(passes.any()) else None
    for row in range(count):
        reason = _untold(arm, goals[row, middle], bool(finite[row]), bool(good[row].any()))
        for choice in passes[row].nonzero().flatten().tolist():
            assert body is not None
            met = body.obstacle(ways[row, choice], opened[row], points, arm_T_table, settings.margin)
            if met is None:
                joints[row], reason = ways[row, choice], ""
                break
            reason = met
        reasons.append(reason)
    passed = torch.tensor([reason == "" for reason in reasons], dtype=torch.bool)
    order = torch.argsort((~passed).long(), stable=True)
    return Reach(arm.joint_names, passed, tuple(reasons), joints, goals, middle, order)


def _way(
    arm: Arm,
    hand: Hand,
    grasps: Grasps,
    arm_T_camera: Float[Tensor, "4 4"],
    motion: TrajectorySettings,
    up: Sequence[float] | None,
) -> tuple[Float[Tensor, "N W 4 4"], int]:
    """Return arm_T_flange along the way and the number of the grasp's own place."""
    back = max(int(np.ceil(motion.retreat / STRIDE - 1e-9)), 1)
    rise = max(int(np.ceil(motion.lift / STRIDE - 1e-9)), 1)
    approach = [pregrasp(hand, grasps, motion.retreat * (1 - k / back), motion.opening)[0] for k in range(back + 1)]
    direction = lift_direction(up, hand, grasps.pose)
    for k in range(1, rise + 1):
        pose = grasps.pose.clone()
        pose[:, :3, 3] += motion.lift * k / rise * direction
        approach.append(pose)
    return arm_T_camera @ torch.stack(approach, dim=1) @ inverse(arm.flange_T_hand), back


def _followed(
    arm: Arm,
    goals: Float[Tensor, "N W 4 4"],
    found: Float[Tensor, "N K A"],
    good: Bool[Tensor, "N K"],
    middle: int,
) -> tuple[Float[Tensor, "N K W A"], Bool[Tensor, "N K"]]:
    """Follow each solution of the grasp in both directions; return all of the way and whether it is whole."""
    places = goals.shape[1]
    ways = torch.full((*found.shape[:2], places, found.shape[2]), torch.nan, dtype=torch.float64)
    ways[:, :, middle] = found
    whole = good.clone()
    for numbers in (range(middle - 1, -1, -1), range(middle + 1, places)):
        last = found
        for number in numbers:
            rows, choices = whole.nonzero(as_tuple=True)
            if len(rows) == 0:
                break
            before = last[rows, choices]
            joints, there = descend(arm, goals[rows, number], before, steps=12)
            there &= (joints - before).abs().amax(dim=1) < JUMP
            ways[rows, choices, number] = joints
            whole[rows, choices] = there
            last = ways[:, :, number]
    return ways, whole


def _untold(arm: Arm, goal: Float[Tensor, "4 4"], finite: bool, solved: bool) -> str:
    """Why there is no way to look at."""
    if not finite:
        return "not a number in its pose"
    if solved:
        return "the grasp can be reached, but not straight from the pre-grasp and up within the joints' limits"
    away = float(goal[:3, 3].norm())
    if away > arm.reach:
        return f"out of reach: the flange would be {away:.2f} m from the base, the arm is {arm.reach:.2f} m long"
    return "no posture within the joints' limits brings the flange there"


def _rigid(given: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    pose = torch.as_tensor(given, dtype=torch.float64)
    turn = pose[:3, :3]
    good = pose.shape == (4, 4) and bool(pose.isfinite().all())
    if not good or (turn.T @ turn - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-4 or torch.linalg.det(turn) < 0:
        raise DexgraspError("camera_T_arm: a rigid motion (4, 4), m", f"{given}", "check rotation, units and order")
    return pose
