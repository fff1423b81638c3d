"""PointNet++ (Qi et al., NeurIPS 2017): set abstraction down, feature propagation back up to the seeds."""

from dexgrasp_pointnet2.network import PointNet2

__all__ = ["PointNet2"]
