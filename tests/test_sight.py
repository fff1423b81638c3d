"""From what cameras saw to one cloud with its table and its objects; and what is refused."""

import logging

import numpy as np
import pytest

from dexgrasp.cloud_file import Capture, read_cloud
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import look_at
from dexgrasp.segmentation import clusters, load_segmenter
from dexgrasp.sight import check, see

torch = pytest.importorskip("torch")


def patch(low, high, step=0.002):
    """Points of an axis-parallel rectangle or block's corner planes, world frame."""
    axes = [np.arange(a, b + 1e-9, step) if b > a else np.array([a]) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def box(x, y, width=0.06, height=0.08):
    """Front (towards -y), left and top of a box on the table."""
    return np.concatenate(
        [
            patch((x, y, 0.002), (x + width, y, height)),
            patch((x, y, 0.002), (x, y + width, height)),
            patch((x, y, height), (x + width, y + width, height)),
        ]
    )


WORLD = np.concatenate([patch((-0.3, -0.2, 0), (0.3, 0.3, 0), 0.003), box(-0.1, 0.0), box(0.05, 0.05), box(0.15, 0.15)])
"""A table and three boxes, z up."""
CAMERA = look_at(torch.tensor([-0.2, -0.6, 0.5]), torch.tensor([0.0, 0.1, 0.0])).numpy()
"""world_T_camera."""


def capture(points, viewpoint=None):
    return Capture(points, None, np.arange(len(points)), len(points), None, viewpoint)


def from_camera(camera=CAMERA):
    motion = np.linalg.inv(camera)
    return WORLD @ motion[:3, :3].T + motion[:3, 3]


def test_table_and_objects_are_found():
    sight = see([capture(from_camera())])
    table_T_world = sight.table_T_camera @ np.linalg.inv(CAMERA)
    assert table_T_world[2, 2] > 0.9999 and abs(table_T_world[2, 3]) < 1e-3
    assert sight.objects == 3 and np.array_equal(sight.told_T_camera, np.eye(4))
    assert (sight.normals * sight.points).sum(1).max() < 0.02  # towards the camera
    world = sight.points @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    assert (world[sight.labels >= 0, 2] > 0.005).all() and (world[sight.labels < 0, 2] < 0.03).all()


def test_views_are_fused_in_the_first_cameras_frame():
    other = look_at(torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0.0, 0.1, 0.0])).numpy()
    sight = see([capture(from_camera()), capture(from_camera(other))], np.stack([CAMERA, other]))
    assert np.array_equal(sight.told_T_camera, CAMERA) and sight.objects == 3
    world = sight.points @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    assert np.abs(world[sight.labels < 0, 2]).max() < 0.03
    with pytest.raises(DexgraspError, match="a pose for each of 2 views"):
        see([capture(from_camera())] * 2, CAMERA[None])


def test_a_cloud_in_another_frame_needs_to_know_where_the_camera_stood():
    with pytest.raises(DexgraspError, match=r"outside any camera's view.*\n.*viewpoint"):
        see([capture(WORLD)])
    for sight in (see([capture(WORLD)], viewpoint=CAMERA[:3, 3]), see([capture(WORLD, CAMERA[:3, 3])])):
        world = sight.points @ sight.told_T_camera[:3, :3].T + sight.told_T_camera[:3, 3]
        assert sight.objects == 3 and np.abs(world[sight.labels < 0, 2]).max() < 0.03


def test_a_mask_makes_its_points_object_0():
    points = from_camera()
    mask = (WORLD[:, 0] > 0.14) & (WORLD[:, 2] > 0.005)
    sight = see([capture(points)], mask=[mask])
    world = sight.points @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    assert sight.objects >= 3 and world[sight.labels == 0, 0].min() > 0.139
    with pytest.raises(DexgraspError, match="a mask of the input's size"):
        see([capture(points)], mask=[mask[:-1]])
    with pytest.raises(DexgraspError, match="mask that marks measured points"):
        see([capture(points)], mask=[np.zeros_like(mask)])


def test_what_is_no_cloud_in_metres_is_refused():
    with pytest.raises(DexgraspError, match="looks like millimetres"):
        check(1000 * from_camera())
    with pytest.raises(DexgraspError, match="another unit"):
        check(0.001 * from_camera())
    with pytest.raises(DexgraspError, match="at least 32"):
        check(from_camera()[:5])


def test_segmenters_are_named_and_checked():
    assert load_segmenter(None) is None
    for name, message in (("nowhere:none", "nowhere"), ("numpy:pi", "no function"), ("numpy:mean", "whole numbers")):
        with pytest.raises(DexgraspError, match=message):
            load_segmenter(name)(np.zeros((5, 3)), None)
    assert load_segmenter(f"{clusters.__module__}:clusters")(WORLD, np.eye(4)).max() == 2


def test_real_scenes_have_a_table_and_objects(shared, caplog):
    for path in sorted((shared / "data/real_scenes").glob("*/*.npz"))[::3]:
        found = see([read_cloud(path)])
        assert found.table_T_camera is not None and found.objects >= 1, path
        up = found.table_T_camera[2, :3]
        assert up @ [0.0, -0.83, -0.56] > 0.99, path  # all of them were seen from above, about 35 degrees down
    with caplog.at_level(logging.WARNING):
        scan = see([read_cloud(shared / "data/real_scenes/gpd_pcd/krylon.pcd")])
    assert "scan of one object" in caplog.text and scan.objects == 1 and scan.table_T_camera is None
