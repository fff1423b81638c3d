"""A grasp told as a type of the hand's own, an approach, an angle, a depth and joint offsets."""

from dexgrasp_grasp_type.grasp_type import GraspType

__all__ = ["GraspType"]
