import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dexgrasp_ros2.messages import cloud_points, joint_trajectory, pose, pose_array
from dexgrasp_ros2.node import Planning, main
from dexgrasp_ros2.planning import plan

from dexgrasp import geometry, load_arm, load_hand
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps


def message(points, kind="<f4", padding=4, height=2):
    """A PointCloud2 of (P, 3): an intensity before each point's x, bytes after each row."""
    layout = np.dtype([("intensity", "<f4"), *((name, kind) for name in "xyz")])
    rows = np.zeros((height, len(points) // height), layout)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis].reshape(rows.shape)
    data = b"".join(row.tobytes() + bytes(padding) for row in rows)
    fields = [
        SimpleNamespace(name=name, offset=layout.fields[name][1], datatype=8 if "f8" in kind else 7, count=1)
        for name in "xyz"
    ]
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="camera", stamp=SimpleNamespace(sec=3, nanosec=5)),
        height=height, width=rows.shape[1], fields=fields, is_bigendian=kind[0] == ">", point_step=layout.itemsize,
        row_step=layout.itemsize * rows.shape[1] + padding, data=data,
    )  # fmt: skip


def scene():
    """A table half a metre ahead of a camera that looks straight down, with a box on it."""
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-0.3, 0.3, (4000, 2)), np.full(4000, 0.6)])
    top = np.column_stack([rng.uniform(-0.03, 0.03, (1000, 2)), np.full(1000, 0.5)])
    return np.concatenate([plane, top])


class Model:
    """Stands in for a trained network: one grasp from above and one far away."""

    points = 4096

    def __init__(self):
        self.hand = load_hand("panda")

    def predict(self, points, normals, top_k):
        places = torch.tensor([[3.0, 0.0, 0.5], [0.0, 0.0, 0.42]], dtype=torch.float64)
        poses = geometry.pose(torch.eye(3, dtype=torch.float64).expand(2, 3, 3), places)
        return Grasps.build(poses, torch.full((2, 1), 0.03, dtype=torch.float64), 2)[:top_k]


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8"])
def test_a_cloud_message_becomes_points(kind):
    points = np.random.default_rng(0).normal(size=(20, 3))
    points[3, 1] = np.nan
    told = cloud_points(message(points, kind))
    assert told.shape == (19, 3) and np.allclose(told, np.delete(points, 3, 0), atol=1e-6)


def test_a_broken_cloud_is_told():
    good = message(np.zeros((4, 3)))
    for spoilt in ({"fields": good.fields[:2]}, {"data": good.data[:-1]}, {"point_step": 8}, {"row_step": 1}):
        with pytest.raises(DexgraspError):
            cloud_points(SimpleNamespace(**{**vars(good), **spoilt}))


def test_poses_are_told_with_w_last():
    matrix = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    told = pose(matrix)
    assert list(told["orientation"]) == ["x", "y", "z", "w"] and told["position"] == {"x": 1, "y": 2, "z": 3}
    assert told["orientation"]["z"] == pytest.approx(0.5**0.5) == told["orientation"]["w"]
    assert pose_array([matrix] * 2, "base", (7, 8))["header"] == {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "base"}


def test_times_are_whole_seconds_and_nanoseconds():
    told = joint_trajectory(["a"], np.array([0.0, 1.5, 1.9999999999]), np.zeros((3, 1)), np.ones((3, 1)))
    assert [point["time_from_start"]["sec"] for point in told["points"]] == [0, 1, 1]
    assert told["points"][1]["time_from_start"]["nanosec"] == 500_000_000
    assert told["points"][2]["time_from_start"]["nanosec"] < 1_000_000_000


def test_a_plan_without_an_arm_takes_the_best():
    answer = plan(Model(), scene(), "camera")
    assert (
        len(answer.grasps["poses"]) == 2
        and answer.arm is None
        and answer.hand["joint_names"] == ["panda_finger_joint1"]
    )
    assert answer.grasps["poses"][0]["position"]["x"] == 3.0


def test_a_plan_with_an_arm_takes_what_it_reaches():
    arm = load_arm("panda")
    arm_T_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    arm_T_camera[:3, 3] = [0.5, 0.0, 0.6]
    answer = plan(Model(), scene(), "camera", arm=arm, camera_T_arm=np.linalg.inv(arm_T_camera))
    assert answer.grasps["poses"][0]["position"]["x"] == 0.0 and "1 of them" in answer.message
    assert answer.arm["joint_names"] == list(arm.joint_names)
    assert len(answer.arm["points"]) == len(answer.hand["points"])
    details = json.loads(answer.details)
    assert [grasp["arm"]["reachable"] for grasp in details["grasps"]] == [True, False]
    assert details["trajectory"]["waypoints"][1]["name"] == "grasp"


def test_the_node_answers_with_the_newest_cloud(monkeypatch):
    """With stand-ins for ROS: the wiring, not ROS itself."""
    kinds = {"geometry_msgs.msg": "PoseArray", "sensor_msgs.msg": "PointCloud2", "std_msgs.msg": "String"}
    kinds |= {"std_srvs.srv": "Trigger", "trajectory_msgs.msg": "JointTrajectory"}
    modules = {name: {kind: type(kind, (), {})} for name, kind in kinds.items()}
    modules |= {"rclpy.qos": {"qos_profile_sensor_data": 10}}
    modules |= {
        "rosidl_runtime_py.set_message": {"set_message_fields": lambda message, told: vars(message).update(told)}
    }
    for name, holds in modules.items():
        monkeypatch.setitem(sys.modules, name.partition(".")[0], SimpleNamespace(__path__=[]))
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**holds))
    monkeypatch.setattr("dexgrasp_ros2.node.load_model", lambda name: Model())
    sent = {}
    node = SimpleNamespace(
        declare_parameter=lambda name, default: SimpleNamespace(value=default),
        create_publisher=lambda kind, topic, depth: SimpleNamespace(publish=lambda made: sent.update({topic: made})),
        create_subscription=lambda *given: None,
        create_service=lambda *given: None,
    )
    planning = Planning(node)
    answer = planning.plan(None, SimpleNamespace())
    assert not answer.success and "none yet" in answer.message
    planning.keep(message(scene()))
    answer = planning.plan(None, SimpleNamespace())
    assert answer.success and answer.message == "2 grasps"
    assert set(sent) == {"~/grasps", "~/hand_trajectory", "~/details"}
    assert sent["~/grasps"].header == {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": "camera"}
    assert len(json.loads(sent["~/details"].data)["grasps"]) == 2


def test_without_ros_the_node_says_what_to_do(monkeypatch):
    assert Planning and not any(name.partition(".")[0] == "rclpy" for name in sys.modules)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match="source ROS 2"):
        main()
