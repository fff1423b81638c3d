"""The level frame in which networks see a scene: the camera's, turned upright and set down on the table.

Which way is up, and how high a point is, decide what a hand can reach. A camera knows neither; its cloud tells both.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.geometry import inverse, pose
from dexgrasp.scene import View
from dexgrasp.table import find_table

LOOKS_DOWN = math.radians(55)
"""Taken where no table is seen: how far the camera looks down,"""
LOWEST = 0.01
"""and the share of the points below z = 0."""


def level_frame(cloud: Float[Tensor, "N 6"], table_T_camera: Float[Tensor, "4 4"] | None) -> Float[Tensor, "4 4"]:
    """Return level_T_camera (float64): z up, table at z = 0, x to the camera's right, origin below the camera.

    `cloud` is in the camera frame, m; `table_T_camera` is what `find_table` says of it. Where that is None, the camera
    is taken to look down by 55 degrees.
    """
    axes = torch.eye(3, dtype=torch.float64)
    if table_T_camera is None:
        up = torch.tensor([0.0, -math.cos(LOOKS_DOWN), -math.sin(LOOKS_DOWN)], dtype=torch.float64)
        height = -torch.quantile(cloud[:, :3].detach().cpu().double() @ up, LOWEST)
    else:
        up, height = table_T_camera[2, :3].double().cpu(), table_T_camera[2, 3].double().cpu()
    # A camera that lies on its side has nothing to its right but up or down: its lower edge takes over.
    side = axes[0] if up[0].abs() < 0.99 else axes[1]
    right = torch.nn.functional.normalize(side - (side @ up) * up, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(up, right), up])
    return pose(rotation, torch.stack([height * 0, height * 0, height]))


def carried(cloud: Float[Tensor, "N 6"], a_T_b: Float[Tensor, "4 4"]) -> Float[Tensor, "N 6"]:
    """Carry positions and normals from frame b to a."""
    motion = a_T_b.to(cloud.device, torch.float64)
    points, normals = cloud.double().split(3, dim=1)
    rotation = motion[:3, :3].T
    return torch.cat([points @ rotation + motion[:3, 3], normals @ rotation], dim=1).to(cloud.dtype)


def levelled(view: View, seed: int = 0) -> View:
    """Return the view in its level frame; `world_T_camera` of the result is world_T_level."""
    cloud = torch.cat([view.points, view.normals], dim=1)
    level_T_camera = level_frame(cloud, find_table(cloud, seed))
    points, normals = carried(cloud, level_T_camera).split(3, dim=1)
    motion = view.world_T_camera.double() @ inverse(level_T_camera)
    return View(points, normals, view.instance, motion.to(view.world_T_camera))
