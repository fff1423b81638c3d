"""A trajectory of the hand with the arm's joints beside it."""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from dexgrasp.arm import Arm
from dexgrasp.errors import DexgraspError
from dexgrasp.motion import Trajectory, smooth
from dexgrasp.reachability import Reach


def with_arm(told: Trajectory, arm: Arm, reach: Reach, row: int) -> Trajectory:
    """Return the trajectory of grasp `row` of `reach` with the arm's joints, slowed down where they would be too fast.

    The arm goes through the places that `reachable` has solved and checked, along cubic splines between them; all
    times are stretched alike, so that no joint of the arm exceeds the URDF's velocity limit.

    Raises:
        DexgraspError: the grasp is not reachable, or `told` is another way than the one that was looked at.
    """
    if not bool(reach.reachable[row]):
        raise DexgraspError("a grasp that the arm reaches", reach.reason[row], "take grasps[reach.order][0]")
    way, middle = reach.joints[row].numpy(), reach.grasp
    there = reach.pose[row].numpy() @ arm.flange_T_hand.numpy()
    here = told.pose[list(told.ends)]
    for ends, pair in (((1, 0), (middle, 0)), ((2, 3), (middle, -1))):
        apart = np.abs(_seen(here, *ends) - _seen(there, *pair)).max()
        if apart > 1e-5:
            remedy = "use the same settings and `up` for both"
            raise DexgraspError("the way that `reachable` looked at", f"one {1e3 * apart:.1f} mm off", remedy)
    joints = np.repeat(way[middle][None], len(told), axis=0)
    speeds = np.zeros_like(joints)
    for begin, end, part in (
        (told.ends[0], told.ends[1], way[: middle + 1]),
        (told.ends[2], told.ends[3], way[middle:]),
    ):
        rows = np.arange(begin, end + 1)
        seconds = told.time[end] - told.time[begin]
        share, rate = smooth((told.time[rows] - told.time[begin]) / seconds)
        spline = CubicSpline(np.linspace(0, 1, len(part)), part)
        joints[rows] = spline(share)
        speeds[rows] = spline(share, 1) * rate[:, None] / seconds
    joints = np.clip(joints, *arm.limits.numpy().T)
    slower = max(1.0, float((np.abs(speeds) / arm.speeds.numpy()).max()))
    return dataclasses.replace(
        told,
        time=told.time * slower,
        speeds=told.speeds / slower,
        arm_joint_names=arm.joint_names,
        arm_joints=joints,
        arm_speeds=speeds / slower,
    )


def _seen(poses: np.ndarray, near: int, far: int) -> np.ndarray:
    """Return the way from one pose to another as seen by the former, (3,)."""
    way = poses[near, :3, :3].T @ (poses[far, :3, 3] - poses[near, :3, 3])
    assert isinstance(way, np.ndarray)
    return way
