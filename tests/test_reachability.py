"""Arms: kinematics against Pinocchio, inverse kinematics, ways that are clear of what was seen."""

import pinocchio as pin
import pytest
import torch

from dexgrasp import geometry, load_arm, load_hand, reachable, trajectory
from dexgrasp.arm_collision import ArmBody
from dexgrasp.arm_motion import with_arm
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.inverse_kinematics import solutions
from dexgrasp.motion import TrajectorySettings

ARMS = ("panda", "ur5", "ur10", "xarm7")
NOWHERE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def panda():
    return load_arm("panda")


def postures(arm, count, seed=0):
    low, high = arm.limits.T
    rng = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, len(low), generator=rng, dtype=torch.float64)


def downward(hand, places):
    """Grasps whose palm looks straight down, their palm's origin at `places` (m)."""
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    palm = geometry.pose(turn.expand(len(places), 3, 3), torch.tensor(places, dtype=torch.float64))
    joints = hand.limits.mean(dim=1).expand(len(places), -1)
    return Grasps.build(palm @ geometry.inverse(hand.base_T_palm), joints, len(hand.fingers))


@pytest.mark.parametrize("name", ARMS)
def test_kinematics_are_pinocchios(name):
    arm = load_arm(name)
    joints = postures(arm, 3)
    flange, jacobian = arm.jacobian(joints)
    data = arm.model.createData()
    frame = arm.model.getFrameId(arm.flange, pin.FrameType.BODY)
    for row, values in enumerate(joints.numpy()):
        pin.computeJointJacobians(arm.model, data, values)
        pin.updateFramePlacements(arm.model, data)
        wanted = pin.getFrameJacobian(arm.model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        assert torch.allclose(flange[row], torch.from_numpy(data.oMf[frame].homogeneous), atol=1e-9)
        assert torch.allclose(jacobian[row], torch.from_numpy(wanted), atol=1e-9)
        assert float(flange[row, :3, 3].norm()) <= arm.reach
    assert arm.hulls and ArmBody(arm, load_hand("panda")).pairs


@pytest.mark.parametrize("name", ARMS)
def test_inverse_kinematics_finds_what_forward_kinematics_made(name):
    arm = load_arm(name)
    goals = arm.link_poses(postures(arm, 100, 1))[arm.flange]
    joints, good = solutions(arm, goals)
    assert float(good.any(dim=1).double().mean()) >= 0.95
    assert bool(((joints >= arm.limits[:, 0]) & (joints <= arm.limits[:, 1])).all())
    made = arm.link_poses(joints[good])[arm.flange]
    wanted = goals[good.nonzero()[:, 0]]
    assert float((made - wanted)[:, :3, 3].norm(dim=1).max()) < 1e-4
    assert float(geometry.rotation_angle(made[:, :3, :3], wanted[:, :3, :3]).max()) < 1.1e-3
    again, same = solutions(arm, goals)
    assert torch.equal(joints, again) and torch.equal(good, same)


def test_reachable_grasps_come_first_and_others_are_told(panda, hand):
    grasps = downward(hand, [[2.0, 0.0, 0.2], [0.5, 0.1, 0.25], [0.1, 0.0, 0.05], [0.5, -0.1, 0.25]])
    told = reachable(panda, hand, grasps, None, NOWHERE, up=(0, 0, 1))
    assert told.reachable.tolist() == [False, True, False, True]
    assert told.order.tolist() == [1, 3, 0, 2]
    assert "out of reach" in told.reason[0] and told.reason[1] == "" and told.reason[2]
    # The way: the flange carries the hand's base through pre-grasp and grasp to the end of the lift, without jumps.
    way = told.joints[1]
    base = panda.link_poses(way)[panda.flange] @ panda.flange_T_hand
    motion = trajectory(grasps[1], hand, frame="arm", up=(0, 0, 1))
    for place, row in ((0, motion.ends[0]), (told.grasp, motion.ends[1]), (-1, motion.ends[3])):
        assert torch.allclose(base[place], torch.from_numpy(motion.pose[row]), atol=2e-3)
    assert float((base[told.grasp] - grasps.pose[1])[:3, 3].norm()) < 2e-4
    assert float(way.diff(dim=0).abs().max()) < 0.5
    assert bool(((way >= panda.limits[:, 0]) & (way <= panda.limits[:, 1])).all())
    assert told.joints[0].isnan().all() and told.as_dict(1)["reachable"] and "grasp" not in told.as_dict(0)


def test_the_frame_of_the_camera_does_not_matter(panda, hand):
    grasps = downward(hand, [[0.5, 0.1, 0.25], [0.45, -0.2, 0.2]])
    camera_T_arm = geometry.inverse(
        geometry.look_at(torch.tensor([1.0, 0.2, 0.8]), torch.tensor([0.5, 0.0, 0.0])).double()
    )
    here = reachable(panda, hand, grasps, None, NOWHERE, table_T_camera=NOWHERE)
    there = reachable(
        panda, hand, grasps.moved(camera_T_arm), None, camera_T_arm, table_T_camera=geometry.inverse(camera_T_arm)
    )
    assert bool(here.reachable.all()) and torch.allclose(here.joints, there.joints, atol=1e-6)


def test_a_wall_of_points_and_a_table_are_in_the_way(panda, hand):
    grasps = downward(hand, [[0.5, 0.0, 0.25]])
    y, z = torch.meshgrid(torch.linspace(-0.6, 0.6, 121), torch.linspace(0.0, 1.0, 101), indexing="ij")
    wall = torch.stack([torch.full_like(y, 0.2), y, z], dim=-1).reshape(-1, 3)
    assert bool(reachable(panda, hand, grasps, wall + torch.tensor([1.0, 0, 0]), NOWHERE, up=(0, 0, 1)).reachable)
    told = reachable(panda, hand, grasps, wall, NOWHERE, up=(0, 0, 1))
    assert not bool(told.reachable) and "meets the cloud" in told.reason[0]
    lifted = NOWHERE.clone()
    lifted[2, 3] = -0.5  # the table half a metre above the arm's foot
    told = reachable(panda, hand, grasps, None, NOWHERE, table_T_camera=lifted)
    assert not bool(told.reachable) and "meets the table" in told.reason[0]


def test_the_mount_counts(panda):
    jaws = load_hand("panda")
    grasps = downward(jaws, [[0.5, 0.0, 0.2]])
    turned = load_arm("panda", flange_T_hand={"xyz": [0, 0, 0], "rpy": [0, 0, -0.785398163397]})
    for arm in (panda, turned):
        told = reachable(arm, jaws, grasps, None, NOWHERE, motion=TrajectorySettings(lift=0.1), up=(0, 0, 1))
        base = arm.link_poses(told.joints[0])[arm.flange] @ arm.flange_T_hand
        assert torch.allclose(base[told.grasp], grasps.pose[0], atol=2e-3)
    assert not torch.allclose(panda.flange_T_hand, turned.flange_T_hand)


def test_bad_input_is_told(panda, hand, tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(f"name: own\nurdf: {panda.urdf}\nroot: panda_link0\nflange: panda_link8\n")
    assert load_arm(str(own)).joint_names == panda.joint_names
    for name, overrides in (
        ("pandas", {}),
        ("panda", {"flange": "panda_link9"}),
        ("panda", {"flange": "panda_link0"}),
        ("panda", {"home": {"panda_joint1": 4.0}}),
        ("panda", {"home": {"elbow": 0.0}}),
        ("panda", {"flange_T_hand": {"xyz": [0, 0]}}),
        ("panda", {"colour": "white"}),
    ):
        with pytest.raises(DexgraspError):
            load_arm(name, **overrides)
    with pytest.raises(DexgraspError, match="rigid"):
        reachable(panda, hand, downward(hand, [[0.5, 0, 0.2]]), None, 1000 * NOWHERE)
    lost = downward(hand, [[0.5, 0.0, float("nan")], [0.5, 0.0, 0.25]])
    assert reachable(panda, hand, lost, None, NOWHERE).order.tolist() == [1, 0]


def test_the_arm_moves_with_the_hand(panda, hand):
    grasps = downward(hand, [[0.5, 0.1, 0.25], [2.0, 0.0, 0.2]])
    reach = reachable(panda, hand, grasps, None, NOWHERE, up=(0, 0, 1))
    fast = TrajectorySettings(base_speed=3.0, rate=200)
    told = trajectory(grasps[0], hand, fast, frame="arm", up=(0, 0, 1))
    both = with_arm(told, panda, reach, 0)
    joints, limits = torch.from_numpy(both.arm_joints), panda.limits
    base = panda.link_poses(joints)[panda.flange] @ panda.flange_T_hand
    assert float((base - torch.from_numpy(both.pose))[:, :3, 3].norm(dim=1).max()) < 1e-3, "straight within 1 mm"
    assert bool(((joints >= limits[:, 0]) & (joints <= limits[:, 1])).all())
    assert both.time[-1] > told.time[-1], "3 m/s is too fast for the arm"
    speeds = torch.from_numpy(both.arm_speeds)
    assert float((speeds.abs() / panda.speeds).max()) == pytest.approx(1.0)
    step = torch.from_numpy(both.time).diff()[:, None]
    assert float((joints.diff(dim=0) / step - 0.5 * (speeds[1:] + speeds[:-1])).abs().max()) < 0.05
    assert both.as_dict()["waypoints"][0]["arm_joints"].keys() == set(panda.joint_names)
    with pytest.raises(DexgraspError, match="reaches"):
        with_arm(told, panda, reach, 1)
    with pytest.raises(DexgraspError, match="same settings"):
        with_arm(trajectory(grasps[0], hand, up=(0, 0, 1)), panda, reachable(
            panda, hand, grasps[0], None, NOWHERE, up=(0, 0, 1), motion=TrajectorySettings(lift=0.05)), 0)  # fmt: skip


def test_nothing_to_reach_is_no_error(panda, hand):
    told = reachable(panda, hand, downward(hand, [[0.5, 0, 0.2]])[:0], torch.rand(100, 3), NOWHERE)
    assert len(told.order) == len(told.reachable) == len(told.reason) == 0
