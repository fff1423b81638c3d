"""The direct pose representation: the ablation without finger projection."""

from dexgrasp_pose.pose import Pose

__all__ = ["Pose"]
