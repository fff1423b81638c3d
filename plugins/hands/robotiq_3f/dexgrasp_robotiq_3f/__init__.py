"""Robotiq 3-finger adaptive gripper: three fingers, four motors; URDF, geometry and a few lines of YAML."""
