"""PointNet's segmentation network (Qi et al., CVPR 2017)."""

from dexgrasp_pointnet.network import PointNet

__all__ = ["PointNet"]
