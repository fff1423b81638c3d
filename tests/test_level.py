"""The level frame: upright, on the table, whichever way the camera is held."""

import math

import pytest
import torch

from dexgrasp.geometry import axis_angle, inverse, look_at, pose
from dexgrasp.level import carried, level_frame, levelled
from dexgrasp.scene import View
from dexgrasp.table import find_table


def seen(elevation: float = 0.9, roll: float = 0.0, count: int = 4000) -> tuple[torch.Tensor, torch.Tensor]:
    """Cloud (camera frame) of half a ball of 4 cm on a table, and world_T_camera."""
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(count, 3, generator=generator).double() * torch.tensor([0.4, 0.4, 0.0]) - torch.tensor(
        [0.2, 0.2, 0]
    )
    up = torch.tensor([0.0, 0.0, 1.0]).expand(count, 3).double()
    ball = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator).double(), dim=1)
    ball[:, 2] = ball[:, 2].abs()
    world = torch.cat([torch.cat([table, 0.04 * ball + torch.tensor([0, 0, 0.04])]), torch.cat([up, ball])], dim=1)
    eye = 0.7 * torch.tensor([-math.cos(elevation), 0.0, math.sin(elevation)])
    turn = pose(
        axis_angle(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor(roll).double()), torch.zeros(3).double()
    )
    world_T_camera = look_at(eye, torch.zeros(3)) @ turn
    return carried(world, inverse(world_T_camera)).float(), world_T_camera


@pytest.mark.parametrize("elevation", [0.5, 0.9, 1.4])
@pytest.mark.parametrize("roll", [0.0, 0.6])
def test_the_table_is_level_and_at_zero(elevation, roll):
    cloud, world_T_camera = seen(elevation, roll)
    level_T_camera = level_frame(cloud, find_table(cloud))
    upright = level_T_camera @ inverse(world_T_camera)
    torch.testing.assert_close(upright[2], torch.tensor([0.0, 0, 1, 0]).double(), atol=2e-3, rtol=0)
    torch.testing.assert_close(level_T_camera[:2, 3], torch.zeros(2).double())
    rotation = level_T_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double())
    assert torch.linalg.det(rotation) > 0
    right = rotation @ torch.tensor([1.0, 0, 0]).double()
    assert right[0] > 0 and abs(right[1]) < 1e-9, "x is the camera's right, turned level"


def test_a_camera_without_roll_keeps_its_right():
    cloud, _ = seen()
    torch.testing.assert_close(
        level_frame(cloud, find_table(cloud))[:3, 0], torch.tensor([1.0, 0, 0]).double(), atol=2e-3, rtol=0
    )


def test_a_camera_on_its_side_has_a_level_frame():
    cloud, _ = seen(0.05, math.pi / 2)
    table = torch.eye(4, dtype=torch.float64)
    table[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    rotation = level_frame(cloud, table)[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double())


def test_without_a_table_the_camera_is_taken_to_look_down():
    cloud, _ = seen(math.radians(55))
    guessed, found = level_frame(cloud, None), level_frame(cloud, find_table(cloud))
    torch.testing.assert_close(guessed, found, atol=5e-3, rtol=0)


def test_a_levelled_view_is_the_same_scene():
    cloud, world_T_camera = seen(0.7, 0.3)
    view = View(cloud[:, :3], cloud[:, 3:], torch.zeros(len(cloud), dtype=torch.long), world_T_camera)
    level = levelled(view)
    both = torch.cat([level.points, level.normals], dim=1)
    torch.testing.assert_close(carried(both, level.world_T_camera), carried(cloud, world_T_camera), atol=1e-5, rtol=0)
