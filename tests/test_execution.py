"""The pre-grasp: straight back along the palm, fingers opened, nothing else moved."""

import math

import torch

from dexgrasp.execution import closing_direction, pregrasp, tilted
from dexgrasp.geometry import axis_angle, inverse, pose
from dexgrasp.grasps import Grasps


def test_stands_back_along_the_palm_with_open_fingers(hand) -> None:
    axis = torch.nn.functional.normalize(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64), dim=1)
    turned = pose(axis_angle(axis, torch.tensor([0.7], dtype=torch.float64)), torch.ones(1, 3, dtype=torch.float64))
    joints = torch.tensor([[0.5, 1.0, 0.2, 2.0]], dtype=torch.float64)
    back, opened = pregrasp(hand, Grasps.build(turned, joints, 3), retreat=0.1, opening=0.35)
    motion = inverse(turned @ hand.base_T_palm) @ back @ hand.base_T_palm
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = -0.1
    torch.testing.assert_close(motion[0], expected)
    torch.testing.assert_close(opened, torch.tensor([[0.5, 0.65, 0.0, 1.65]], dtype=torch.float64))


def test_closing_direction_names_the_closing_joints(hand) -> None:
    assert closing_direction(hand).tolist() == [0, 1, 1, 1]


def test_tilt_is_measured_from_straight_down(hand) -> None:
    down = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    poses = []
    for degrees in (0.0, 29.0, 31.0, 90.0, 180.0):
        turn = torch.eye(4, dtype=torch.float64)
        turn[:3, :3] = axis_angle(torch.tensor([1.0, 0, 0]).double(), torch.tensor(math.radians(degrees)).double())
        poses.append(turn @ down)
    grasps = Grasps.build(torch.stack(poses), torch.zeros(5, 4).double(), 3)
    assert tilted(hand, grasps, 30.0).tolist() == [False, False, True, True, True]
    assert not tilted(hand, grasps, None).any()
