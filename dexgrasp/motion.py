"""One grasp as a motion in time: pre-grasp, approach, close and lift, for the hand's base and every joint of it."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.execution import closing_directions, pregrasp
from dexgrasp.geometry import rotate
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand

PHASES = ("approach", "close", "lift")
WAYPOINTS = ("pregrasp", "grasp", "closed", "lifted")
"""Where the phases begin and end."""
PEAK = 1.875
"""Top speed over mean speed of `smooth`."""


@dataclass(frozen=True)
class TrajectorySettings:
    """How fast and how far. Metres, radians, seconds."""

    retreat: float = 0.10
    """Length of the straight approach; what `selection.retreat` was checked with."""
    opening: float = 0.35
    """How much the closing joints are opened for the approach (rad, or m where prismatic), within limits."""
    squeeze: float = 0.10
    """How far touching fingers are commanded past the grasp's joints (rad, or m where prismatic), within limits: a
    position controller makes force of it. 0 for a hand that stops and squeezes by itself."""
    lift: float = 0.15
    """Height of the lift."""
    base_speed: float = 0.25
    """Top speed of the base, m/s."""
    joint_speed: float = 1.0
    """Top speed of the hand's joints, rad/s or m/s; the URDF's velocity limits bind as well."""
    rate: float = 50.0
    """Samples per second."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = name in ("base_speed", "joint_speed", "rate")
            if not (math.isfinite(value) and (value > 0 if positive else value >= 0)):
                least = "above 0" if positive else "of at least 0"
                raise DexgraspError(f"{name}: a finite number {least}", repr(value), f"mend {name} of the trajectory")


@dataclass(frozen=True, eq=False)
class Trajectory:
    """T samples of one motion; it begins and ends, and changes from phase to phase, at rest."""

    hand: str
    frame: str
    """Frame of `pose` in words: `camera`, `world`, the robot's base, ..."""
    score: float
    """Score of the grasp."""
    joint_names: tuple[str, ...]
    """All movable joints of the hand, coupled ones included, in the order of its full joint vector."""
    independent: tuple[str, ...]
    """Those that are commanded; the others follow."""
    time: Float[np.ndarray, "T"]
    """s, from 0."""
    phase: tuple[str, ...]
    """Of each sample, one of `PHASES`; the first sample of a phase is the last of the one before, told once."""
    pose: Float[np.ndarray, "T 4 4"]
    """frame_T_base, m."""
    joints: Float[np.ndarray, "T M"]
    """rad, or m where prismatic."""
    speeds: Float[np.ndarray, "T M"]
    """rad/s or m/s."""
    ends: tuple[int, ...]
    """Samples of the four `WAYPOINTS`."""
    arm_joint_names: tuple[str, ...] = ()
    """Joints of the arm that carries the hand, where there is one: `dexgrasp.arm_motion.with_arm`."""
    arm_joints: Float[np.ndarray, "T A"] | None = None
    """rad, or m where prismatic."""
    arm_speeds: Float[np.ndarray, "T A"] | None = None
    """rad/s or m/s."""

    def __len__(self) -> int:
        return len(self.time)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values: the documented JSON of docs/motion.md, `dexgrasp_trajectory` version 1."""
        told: dict[str, Any] = {
            "format": "dexgrasp_trajectory",
            "format_version": 1,
            "hand": self.hand,
            "frame": self.frame,
            "units": {"length": "m", "angle": "rad", "time": "s"},
            "score": self.score,
            "joint_names": list(self.joint_names),
            "independent_joints": list(self.independent),
            "waypoints": [self._waypoint(name, row) for name, row in zip(WAYPOINTS, self.ends, strict=True)],
            "samples": {
                "time": self.time.tolist(),
                "phase": list(self.phase),
                "frame_T_base": self.pose.tolist(),
                "joints": self.joints.tolist(),
                "speeds": self.speeds.tolist(),
            },
        }
        if self.arm_joints is not None and self.arm_speeds is not None:
            told["arm_joint_names"] = list(self.arm_joint_names)
            told["samples"] |= {"arm_joints": self.arm_joints.tolist(), "arm_speeds": self.arm_speeds.tolist()}
        return told

    def save(self, path: str | Path) -> Path:
        """Write `as_dict` as JSON."""
        Path(path).write_text(json.dumps(self.as_dict()) + "\n")
        return Path(path)

    def _waypoint(self, name: str, row: int) -> dict[str, Any]:
        told: dict[str, Any] = {
            "name": name,
            "time": float(self.time[row]),
            "frame_T_base": self.pose[row].tolist(),
            "joints": dict(zip(self.joint_names, self.joints[row].tolist(), strict=True)),
        }
        if self.arm_joints is not None:
            told["arm_joints"] = dict(zip(self.arm_joint_names, self.arm_joints[row].tolist(), strict=True))
        return told


def trajectory(
    grasp: Grasps,
    hand: Hand,
    settings: TrajectorySettings | None = None,
    *,
    frame: str = "camera",
    up: Sequence[float] | None = None,
) -> Trajectory:
    """Return the motion that carries out one grasp.

    The open hand stands back along the palm's approach direction (`pregrasp`), comes straight forward (approach),
    closes the touching fingers through the grasp's joints and by `squeeze` beyond (close), and is raised along `up`
    (lift). Speeds are zero at both ends of each phase and smooth between (`smooth`).

    Args:
        grasp: a single row of `Grasps`, e.g. ``grasps[0]``.
        hand: its hand.
        settings: lengths and speeds; defaults where None.
        frame: what the frame of `grasp.pose` is called.
        up: direction of the lift in that frame; None: straight back against the approach. Of predictions in the
            camera's frame the table's normal, ``find_table(cloud)[2, :3]``; (0, 0, 1) in a world frame.

    Raises:
        DexgraspError: not one grasp, of another hand, numbers that are not finite, or no direction.
    """
    settings = settings or TrajectorySettings()
    _check(grasp, hand)
    grasp = grasp.to("cpu", torch.float64)
    back, opened = pregrasp(hand, grasp, settings.retreat, settings.opening)
    direction = closing_directions(hand, grasp.touching)
    closed = hand.clamp(grasp.joints + settings.squeeze * direction)[0].numpy()
    far, near, open_joints = back[0].numpy(), grasp.pose[0].numpy(), opened[0].numpy()
    raised = near.copy()
    raised[:3, 3] += settings.lift * lift_direction(up, hand, grasp.pose)[0].numpy()
    poses, postures = [far, near, near, raised], [open_joints, open_joints, closed, closed]
    matrix, offset, names = full_joints(hand)
    most = np.minimum(speed_limits(hand), settings.joint_speed)
    parts, ends, now = [], [0], 0.0
    for phase in range(len(PHASES)):
        a, b, p, q = poses[phase], poses[phase + 1], postures[phase], postures[phase + 1]
        way, turn = b[:3, 3] - a[:3, 3], q - p
        slowest = float((np.abs(turn) / most).max(initial=0.0))
        seconds = PEAK * max(float(np.linalg.norm(way)) / settings.base_speed, slowest)
        count = max(math.ceil(seconds * settings.rate), 1)
        share, speed = smooth(np.arange(0 if phase == 0 else 1, count + 1) / count)
        seconds = max(seconds, 1 / settings.rate)
        pose = np.repeat(a[None], len(share), axis=0)
        pose[:, :3, 3] += share[:, None] * way
        joints = (p + share[:, None] * turn) @ matrix.T + offset
        speeds = (speed[:, None] / seconds * turn) @ matrix.T
        time = now + seconds * np.arange(count + 1)[-len(share) :] / count
        parts.append((time, pose, joints, speeds, [PHASES[phase]] * len(share)))
        now, ends = now + seconds, [*ends, ends[-1] + count]
    times, pose, joints, speeds = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return Trajectory(
        hand=hand.name,
        frame=frame,
        score=float(grasp.quality[0]),
        joint_names=names,
        independent=hand.joint_names,
        time=times,
        phase=tuple(name for part in parts for name in part[4]),
        pose=pose,
        joints=joints,
        speeds=speeds,
        ends=tuple(ends),
    )


def smooth(share: Float[np.ndarray, "T"]) -> tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T"]]:
    """Return the way and its speed at a share 0..1 of the time: the minimum-jerk profile (Flash & Hogan 1985)."""
    t = np.clip(share, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2


def full_joints(hand: Hand) -> tuple[Float[np.ndarray, "M J"], Float[np.ndarray, "M"], tuple[str, ...]]:
    """Return (A, b, names): all movable joints of a hand are A joints + b; the independent ones where that is all."""
    names = getattr(hand, "full_joint_names", None)
    if names is None:
        return np.eye(len(hand.joint_names)), np.zeros(len(hand.joint_names)), hand.joint_names
    matrix, offset = hand.coupling  # type: ignore[attr-defined]
    return matrix.numpy(), offset.numpy(), tuple(names)


def speed_limits(hand: Hand) -> Float[np.ndarray, "J"]:
    """Return each independent joint's speed limit (rad/s or m/s): no joint that it moves exceeds the URDF's.

    Infinite where the URDF gives none, or 0.
    """
    matrix, _, _ = full_joints(hand)
    model = getattr(hand, "model", None)
    if model is None:
        return np.full(len(hand.joint_names), np.inf)
    given = np.asarray(model.velocityLimit, dtype=np.float64)
    given = np.where((given > 0) & np.isfinite(given), given, np.inf)
    with np.errstate(divide="ignore"):
        return (given[:, None] / np.abs(matrix)).min(axis=0, initial=np.inf)


def lift_direction(up: Sequence[float] | None, hand: Hand, pose: Float[Tensor, "N 4 4"]) -> Float[Tensor, "N 3"]:
    """Return the unit direction of each grasp's lift in the frame of `pose`: `up`, or back against the approach."""
    if up is None:
        return rotate(pose, -hand.base_T_palm[:3, 2].to(pose).expand(len(pose), 3))
    given = torch.as_tensor(up, dtype=pose.dtype)
    length = float(given.norm())
    if given.shape != (3,) or not (math.isfinite(length) and length > 0):
        raise DexgraspError("three finite numbers, not all 0, as `up`", repr(up), "give it in the grasp's frame")
    return (given / length).expand(len(pose), 3)


def _check(grasp: Grasps, hand: Hand) -> None:
    if len(grasp) != 1:
        none = "none passed: look at len(grasps) first; a nearer view, or a `Selection` that asks for less, may help"
        raise DexgraspError("one grasp", f"{len(grasp)}", "take a row: grasps[0]" if len(grasp) else none)
    joints, fingers = grasp.joints.shape[1], grasp.touching.shape[1]
    if joints != len(hand.joint_names) or fingers != len(hand.fingers):
        raise DexgraspError(
            f"{len(hand.joint_names)} joints and {len(hand.fingers)} fingers of {hand.name!r}",
            f"a grasp of {joints} joints and {fingers} fingers",
            "take the hand for which it was predicted: model.hand",
        )
    if not bool(grasp.pose.isfinite().all() and grasp.joints.isfinite().all()):
        raise DexgraspError("a grasp of finite numbers", "NaN or infinity", "leave it out")
