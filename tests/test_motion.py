"""Grasps as motions: limits, continuity, couplings, the way they take."""

import json
import math

import numpy as np
import pinocchio as pin
import pytest
import torch

from dexgrasp import geometry, load_hand, trajectory
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.motion import PHASES, WAYPOINTS, TrajectorySettings, speed_limits

HANDS = ("barrett", "allegro_right", "robotiq_3f", "panda", "ability")


def grasps_of(hand, count=1, seed=0):
    """Grasps in places and of joints drawn at random, the latter in the middle of their limits."""
    rng = torch.Generator().manual_seed(seed)
    low, high = hand.limits.T
    joints = low + (0.3 + 0.4 * torch.rand(count, len(low), generator=rng, dtype=torch.float64)) * (high - low)
    rotation = geometry.orthonormal(torch.randn(count, 6, generator=rng, dtype=torch.float64))
    place = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return Grasps.build(geometry.pose(rotation, place).float(), joints.float(), len(hand.fingers))


@pytest.mark.parametrize("name", HANDS)
def test_it_keeps_limits_is_continuous_and_couples_joints(name):
    hand = load_hand(name)
    grasp = grasps_of(hand)
    settings = TrajectorySettings(retreat=0.08, lift=0.2)
    told = trajectory(grasp, hand, settings, frame="world", up=(0, 0, 2))
    independent = [told.joint_names.index(joint) for joint in hand.joint_names]
    low, high = hand.limits.numpy().T
    assert (told.joints[:, independent] >= low - 1e-9).all() and (told.joints[:, independent] <= high + 1e-9).all()
    # Speeds told are those of the positions, below the limits, and zero where phases meet.
    step = np.diff(told.time)
    assert (step > 0).all() and step.max() <= 1 / settings.rate + 1e-9
    middle = 0.5 * (told.speeds[1:] + told.speeds[:-1])
    assert np.abs(np.diff(told.joints, axis=0) / step[:, None] - middle).max() < 0.02
    assert (np.abs(told.speeds[:, independent]).max(axis=0) <= np.minimum(speed_limits(hand), 1.0) + 1e-9).all()
    base = np.linalg.norm(np.diff(told.pose[:, :3, 3], axis=0), axis=1) / step
    assert base.max() <= settings.base_speed + 1e-9
    assert np.abs(told.speeds[list(told.ends)]).max() < 1e-9
    wide = trajectory(grasp, hand, TrajectorySettings(opening=3, squeeze=3)).joints
    assert (wide <= hand.model.upperPositionLimit + 1e-9).all() and (wide >= hand.model.lowerPositionLimit - 1e-9).all()
    # Coupled joints, by Pinocchio's own model of the URDF with all joints ordinary: links where the hand has them.
    model, row = hand.model, len(told) // 2
    data = model.createData()
    pin.framesForwardKinematics(model, data, told.joints[row])
    assert told.joint_names == tuple(model.names[1:])
    poses = hand.link_poses(torch.from_numpy(told.joints[row : row + 1, independent]))
    for link, pose in poses.items():
        assert np.allclose(
            data.oMf[model.getFrameId(link, pin.FrameType.BODY)].homogeneous, pose[0].numpy(), atol=1e-9
        ), link


def test_it_goes_where_the_grasp_says(hand):
    grasp = grasps_of(hand)
    told = trajectory(grasp, hand, TrajectorySettings(retreat=0.08, lift=0.2), up=(0, 0, 1))
    start, arrived, closed, lifted = told.ends
    pose = grasp.pose[0].double().numpy()
    approach = pose[:3, :3] @ hand.base_T_palm[:3, 2].numpy()
    assert np.allclose(told.pose[start, :3, 3], pose[:3, 3] - 0.08 * approach, atol=1e-7)
    assert np.allclose(told.pose[arrived], pose) and np.allclose(told.pose[closed], pose)
    assert np.allclose(told.pose[lifted, :3, 3], pose[:3, 3] + [0, 0, 0.2])
    assert np.allclose(told.joints[closed], told.joints[lifted]) and np.allclose(told.joints[0], told.joints[arrived])
    names = [joint for finger in hand.fingers for joint in finger.closing]
    wanted = grasp.joints[0].double()
    for joint in names:
        column, number = told.joint_names.index(joint), hand.joint_names.index(joint)
        assert told.joints[arrived, column] < float(wanted[number]) < told.joints[closed, column]
    assert told.phase[0] == PHASES[0] and told.phase[-1] == PHASES[-1]


def test_fingers_that_do_not_touch_stay():
    hand = load_hand("allegro_right")
    grasp = grasps_of(hand)
    touching = grasp.touching.clone()
    touching[0, 1] = False
    told = trajectory(grasp.replace(touching=touching), hand)
    column = [told.joint_names.index(joint) for joint in hand.fingers[1].closing]
    assert np.ptp(told.joints[:, column], axis=0).max() < 1e-12 and np.ptp(told.joints, axis=0).max() > 0.1


def test_json_says_it_all(hand, tmp_path):
    told = trajectory(grasps_of(hand), hand)
    content = json.loads(told.save(tmp_path / "grasp.json").read_text())
    assert content == json.loads(json.dumps(told.as_dict()))
    assert [point["name"] for point in content["waypoints"]] == list(WAYPOINTS)
    assert len(content["samples"]["joints"]) == len(told) and len(content["joint_names"]) == told.joints.shape[1]
    assert content["frame"] == "camera"


def test_no_direction_means_back_the_way_it_came(hand):
    told = trajectory(grasps_of(hand), hand, TrajectorySettings(retreat=0.1, lift=0.1))
    assert np.allclose(told.pose[told.ends[0]], told.pose[told.ends[3]], atol=1e-7)


@pytest.mark.parametrize("spoil", [
    lambda grasps, hand: (grasps, hand, None),
    lambda grasps, hand: (grasps[0].replace(pose=grasps.pose[:1] * math.nan), hand, None),
    lambda grasps, hand: (grasps[0], load_hand("panda"), None),
    lambda grasps, hand: (grasps[0], hand, (0, 0, 0)),
])  # fmt: skip
def test_bad_input_is_told(hand, spoil):
    grasp, of, up = spoil(grasps_of(hand, 2), hand)
    with pytest.raises(DexgraspError):
        trajectory(grasp, of, up=up)
    with pytest.raises(DexgraspError):
        TrajectorySettings(base_speed=0)
