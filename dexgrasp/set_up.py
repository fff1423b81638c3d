"""Grasps set up for a table: upright where they are nearly so, and above it.

Networks err by some degrees and millimetres. Labels of low things come straight down, with all fingertips just above
the table: no more is left between sliding off the top and hitting the table.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.execution import pregrasp
from dexgrasp.geometry import axis_angle, rotate
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand


def upright(hand: Hand, grasps: Grasps, table: Float[Tensor, "4 4"], most: float) -> Grasps:
    """Return the grasps, those turned to approach straight down that do so within `most` (rad).

    Turned about the middle of the fingertips; what a grasp tells of contacts stays. `table` is table_T_frame (m), of
    the grasps' frame.
    """
    approach = rotate(grasps.pose, hand.base_T_palm[:3, 2].to(grasps.pose).expand(len(grasps), 3))
    down = -table[2, :3].to(approach).expand_as(approach)
    axis = torch.linalg.cross(approach, down)
    sine = torch.linalg.vector_norm(axis, dim=1)
    angle = torch.atan2(sine, (approach * down).sum(dim=1))
    turn = axis_angle(axis / sine.clamp(min=1e-9)[:, None], torch.where(angle < most, angle, 0.0))
    middle = (grasps.pose[:, None] @ hand.fingertips(grasps.joints).to(grasps.pose))[..., :3, 3].mean(dim=1)
    pose = grasps.pose.clone()
    pose[:, :3, :3] = turn @ pose[:, :3, :3]
    pose[:, :3, 3] = (turn @ (pose[:, :3, 3] - middle).unsqueeze(-1)).squeeze(-1) + middle
    return grasps.replace(pose=torch.where((angle < most)[:, None, None], pose, grasps.pose))


def above(
    hand: Hand, shape: Any, grasps: Grasps, table: Float[Tensor, "4 4"], most: float, gap: float, opening: float
) -> Grasps:
    """Return the grasps, those raised to `gap` above the table that reach into it by less than `most` (m).

    Closed, or opened by `opening` (rad) as on the way. Moved along the table's normal; what a grasp tells of contacts
    stays. `table` is table_T_frame, `shape` the hand's `HandShape`.
    """
    _, joints = pregrasp(hand, grasps, 1.0, opening)
    motion = table.to(grasps.pose)
    places, both = (motion @ grasps.pose).repeat(2, 1, 1), torch.cat([grasps.joints, joints])
    height = torch.as_tensor(shape.table_distance(places, both)).unflatten(0, (2, -1)).amin(dim=0)
    near = (height > -most) & (height < 0)
    pose = grasps.pose.clone()
    pose[:, :3, 3] += torch.where(near, gap - height, 0.0)[:, None].to(pose) * motion[2, :3]
    return grasps.replace(pose=pose)
