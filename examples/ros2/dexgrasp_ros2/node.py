"""The node: keeps the newest cloud, and plans when it is asked to (std_srvs/Trigger on `~/plan`).

Subscribes to `cloud` (sensor_msgs/PointCloud2). Publishes `~/grasps` (geometry_msgs/PoseArray), `~/hand_trajectory` and
`~/arm_trajectory` (trajectory_msgs/JointTrajectory) and `~/details` (std_msgs/String, JSON). Parameters: `model`,
`top_k`, `arm` (empty: none), `camera_T_arm` (x, y, z, roll, pitch, yaw of the arm's base in the cloud's frame).
"""

import sys
from typing import Any

from dexgrasp import load_arm, load_model
from dexgrasp.arm import placement
from dexgrasp.errors import DexgraspError
from dexgrasp_ros2.messages import cloud_points
from dexgrasp_ros2.planning import plan


def main() -> None:
    """Start the node; Ctrl-C ends it."""
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException
    except ImportError:
        sys.exit("rclpy is not there: source ROS 2's setup.bash first, with the Python for which it was built")
    rclpy.init()
    node = rclpy.create_node("dexgrasp")
    Planning(node)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class Planning:
    """What hangs on the node."""

    def __init__(self, node: Any) -> None:
        from geometry_msgs.msg import PoseArray
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String
        from std_srvs.srv import Trigger
        from trajectory_msgs.msg import JointTrajectory

        self.node, self.cloud = node, None
        told = {"model": "barrett", "top_k": 20, "arm": "", "camera_T_arm": [0.0] * 6}
        given = {name: node.declare_parameter(name, default).value for name, default in told.items()}
        self.model, self.top_k = load_model(given["model"]), given["top_k"]
        self.arm = load_arm(given["arm"]) if given["arm"] else None
        mount = list(given["camera_T_arm"])
        self.camera_T_arm = placement({"xyz": mount[:3], "rpy": mount[3:]}, "camera_T_arm").numpy()
        kinds = {"grasps": PoseArray, "hand": JointTrajectory, "arm": JointTrajectory, "details": String}
        topics = {"hand": "~/hand_trajectory", "arm": "~/arm_trajectory"}
        self.kinds = kinds
        self.outputs = {
            name: node.create_publisher(kind, topics.get(name, f"~/{name}"), 1) for name, kind in kinds.items()
        }
        node.create_subscription(PointCloud2, "cloud", self.keep, qos_profile_sensor_data)
        node.create_service(Trigger, "~/plan", self.plan)

    def keep(self, message: Any) -> None:
        """Keep the newest cloud."""
        self.cloud = message

    def plan(self, request: Any, response: Any) -> Any:
        """Plan for the newest cloud and publish the answer."""
        from rosidl_runtime_py.set_message import set_message_fields

        try:
            if self.cloud is None:
                raise DexgraspError("a cloud", "none yet", "publish a PointCloud2 on the topic `cloud`")
            head = self.cloud.header
            answer = plan(
                self.model,
                cloud_points(self.cloud),
                head.frame_id,
                stamp=(head.stamp.sec, head.stamp.nanosec),
                top_k=self.top_k,
                arm=self.arm,
                camera_T_arm=self.camera_T_arm,
            )
        except DexgraspError as error:
            response.success, response.message = False, str(error)
            return response
        for name, values in {**vars(answer), "details": {"data": answer.details}}.items():
            if name in self.kinds and values is not None:
                message = self.kinds[name]()
                set_message_fields(message, values)
                self.outputs[name].publish(message)
        response.success, response.message = answer.hand is not None, answer.message
        return response


if __name__ == "__main__":
    main()
