"""dexgrasp: hand-agnostic, multi-finger grasping."""
