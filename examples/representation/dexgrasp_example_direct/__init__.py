"""A grasp told as plain numbers: offset, rotation, joints."""

from dexgrasp_example_direct.direct import Direct

__all__ = ["Direct"]
