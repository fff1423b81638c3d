"""From a cloud to the messages of an answer: what the node does between receiving and sending."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from dexgrasp import reachable, trajectory
from dexgrasp.arm import Arm
from dexgrasp.arm_motion import with_arm
from dexgrasp.cloud import prepare
from dexgrasp.table import find_table
from dexgrasp_ros2 import messages


@dataclass(frozen=True)
class Answer:
    """Messages as dictionaries; trajectories of the best grasp, None where there is none."""

    grasps: dict[str, Any]
    """geometry_msgs/PoseArray: the hand's base, best grasp first."""
    hand: dict[str, Any] | None
    """trajectory_msgs/JointTrajectory of the joints that are commanded."""
    arm: dict[str, Any] | None
    """The same of the arm, with the same times."""
    details: str
    """JSON: scores, joints, why a grasp cannot be reached, and the whole trajectory of the best (docs/motion.md)."""
    message: str
    """What came of it, for people."""


def plan(
    model: Any,
    points: np.ndarray,
    frame: str,
    *,
    stamp: tuple[int, int] = (0, 0),
    top_k: int = 20,
    arm: Arm | None = None,
    camera_T_arm: np.ndarray | None = None,
) -> Answer:
    """Predict grasps in a cloud (P, 3) of `frame`, m; with an arm, reachable ones first and how it goes there."""
    cloud = prepare(points, None, model.points, 0)
    table = find_table(cloud)
    grasps = model.predict(cloud[:, :3], cloud[:, 3:], top_k=top_k)
    up = None if table is None else table[2, :3].tolist()
    reach, good = None, len(grasps) > 0
    if arm is not None and good:
        base = torch.as_tensor(np.eye(4) if camera_T_arm is None else camera_T_arm)
        reach = reachable(arm, model.hand, grasps, cloud, base, table_T_camera=table)
        good = bool(reach.reachable.any())
    order = list(range(len(grasps))) if reach is None else reach.order.tolist()
    told = trajectory(grasps[order[0]], model.hand, frame=frame, up=up) if good else None
    if told is not None and reach is not None and arm is not None:
        told = with_arm(told, arm, reach, order[0])
    listed = [
        {
            "score": float(grasps.quality[row]),
            "joints": dict(zip(model.hand.joint_names, grasps.joints[row].tolist(), strict=True)),
            "arm": None if reach is None else reach.as_dict(row),
        }
        for row in order
    ]
    details = {"frame": frame, "grasps": listed, "trajectory": None if told is None else told.as_dict()}
    hand_message = arm_message = None
    if told is not None:
        columns = [told.joint_names.index(joint) for joint in told.independent]
        hand_message = messages.joint_trajectory(
            told.independent, told.time, told.joints[:, columns], told.speeds[:, columns], frame, stamp
        )
        if told.arm_joints is not None and told.arm_speeds is not None:
            arm_message = messages.joint_trajectory(
                told.arm_joint_names, told.time, told.arm_joints, told.arm_speeds, frame, stamp
            )
    reached = "" if reach is None else f", {int(reach.reachable.sum())} of them within the arm's reach"
    return Answer(
        messages.pose_array([grasps.pose[row].double().numpy() for row in order], frame, stamp),
        hand_message,
        arm_message,
        json.dumps(details),
        f"{len(grasps)} grasps{reached}",
    )
