"""The EigenGrasp planner: a baseline that knows the objects' meshes and poses."""

from dexgrasp_eigengrasp.planner import EigenGrasp

__all__ = ["EigenGrasp"]
