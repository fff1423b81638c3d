"""Grasps of real scenes are plausible. Needs a trained network: DEXGRASP_MODEL=RUN, else weights that are shipped."""

import os
from pathlib import Path

import numpy as np
import pytest

from dexgrasp.checkpoint import WEIGHTS
from dexgrasp.cloud_file import read_cloud
from dexgrasp.model import load_model
from dexgrasp.prediction import predict_sight
from dexgrasp.sight import see

pytestmark = pytest.mark.slow
SCENES = [
    *(f"mosd_kinect/test{number}.npz" for number in (31, 36, 45, 47, 50, 55, 60, 61, 62, 64)),
    "pcl_tutorials/milk_cartoon_all_small_clorox.npz",
    "pcl_tutorials/table_scene_mug_stereo_textured.npz",
    "gpd_pcd/table_mug.pcd",
    "gpd_pcd/krylon.pcd",
]


@pytest.fixture(scope="module")
def model():
    shipped = sorted(WEIGHTS.glob("*.safetensors"))
    told = os.environ.get("DEXGRASP_MODEL") or (str(shipped[0]) if shipped else None)
    if told is None:
        pytest.skip("no trained weights: none are shipped, and DEXGRASP_MODEL tells of none")
    return load_model(told)


def solids(hand, joints, base):
    """Planes (normal, offset; inside is negative) of every convex part of the hand, in the frame of `base`."""
    poses = hand.link_poses(joints[None])
    for link, parts in hand.collisions.items():
        if link in poses:
            motion = (base @ poses[link][0]).numpy()
            for part in parts:
                normals = part.face_normals @ motion[:3, :3].T
                corners = part.triangles[:, 0] @ motion[:3, :3].T + motion[:3, 3]
                yield normals, -(normals * corners).sum(1), part.vertices @ motion[:3, :3].T + motion[:3, 3]


@pytest.mark.parametrize("scene", SCENES)
def test_grasps_are_plausible(shared: Path, model, scene: str) -> None:
    capture = read_cloud(shared / "data/real_scenes" / scene)
    sight = see([capture])
    found = predict_sight(model, sight, top_k=5)
    assert len(found.grasps) >= 3
    hand, raw = model.hand, capture.points @ np.linalg.inv(sight.told_T_camera)[:3, :3].T
    raw = raw + np.linalg.inv(sight.told_T_camera)[:3, 3]
    up, height = (0, 0) if sight.table_T_camera is None else np.split(sight.table_T_camera[2], [3])
    for i in range(len(found.grasps)):
        grasp = found.grasps[i]
        joints, base = grasp.joints[0].double(), grasp.pose[0].double()
        own = sight.points[sight.labels == int(grasp.object[0])]
        near = raw[np.linalg.norm(raw - base[:3, 3].numpy(), axis=1) < 0.4]
        deep = np.zeros(len(near), dtype=bool)
        for normals, offsets, corners in solids(hand, joints, base):
            middle = corners.mean(axis=0)
            around = np.linalg.norm(near - middle, axis=1) < np.linalg.norm(corners - middle, axis=1).max()
            deep[around] |= (near[around] @ normals.T + offsets).max(axis=1) < -0.005
            if sight.table_T_camera is not None:
                assert (corners @ up + height).min() > -0.003  # not through the table
        # Of the raw cloud, flying pixels between an object and what is behind it may lie in the hand.
        assert deep.sum() <= max(3, 0.0005 * len(near))
        tips = (base @ hand.fingertips(joints[None])[0])[:, :3, 3].numpy()
        gaps = np.array([np.linalg.norm(own - tip, axis=1).min() for tip in tips])
        gaps -= [finger.tip_radius for finger in hand.fingers]
        touching = grasp.touching[0].numpy()
        assert gaps[touching].min() < 0.008  # on what was seen
        assert gaps[touching].max() < 0.08  # and nowhere far from it: the other side was not seen
