"""A Multi-FinGAN-style planner: a grasp type for each object, then its pose and joints refined by a generator."""

from dexgrasp_multifingan.planner import MultiFinGan

__all__ = ["MultiFinGan"]
