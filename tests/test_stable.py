"""Stable resting poses against bodies whose answer is known."""

import numpy as np
import pytest
import trimesh

from dexgrasp.objects import shape
from dexgrasp.stable import stable_poses


def test_cube_has_six_equal_poses() -> None:
    cube = trimesh.creation.box([0.05, 0.05, 0.05])
    poses, chance = stable_poses(cube.vertices, cube.center_mass)
    assert len(poses) == 6
    assert chance == pytest.approx(np.full(6, 1 / 6), abs=1e-9)


def test_box_prefers_its_large_faces() -> None:
    box = trimesh.creation.box([0.02, 0.06, 0.12])
    poses, chance = stable_poses(box.vertices, box.center_mass)
    heights = poses[:, 2, 3]
    assert len(poses) == 6
    assert np.all(np.diff(heights[:2]) == pytest.approx(0)) and heights[0] == pytest.approx(0.01)
    assert heights[-1] == pytest.approx(0.06) and chance[0] > chance[-1]


def test_facet_that_does_not_hold_the_centre_is_left() -> None:
    """A sheared column falls over: its small end is no resting pose."""
    column = trimesh.creation.box([0.02, 0.02, 0.2])
    column.vertices[:, 0] += 0.5 * column.vertices[:, 2]
    poses, chance = stable_poses(column.vertices, column.center_mass)
    assert len(poses) == 4 and chance.sum() == pytest.approx(1)
    assert (poses[:, 2, 3] < 0.02).all()


@pytest.mark.parametrize("family", ["mug", "hammer", "ball", "bottle", "teapot"])
def test_poses_rest_on_the_table_and_hold_the_centre(family: str) -> None:
    item = shape(family, 2)
    poses, chance = item.stable
    assert chance.sum() == pytest.approx(1) and (np.diff(chance) <= 1e-12).all()
    for pose in poses:
        assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        placed = item.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        assert placed[:, 2].min() == pytest.approx(0, abs=1e-9)
        assert (pose[:3, :3] @ item.com + pose[:3, 3])[:2] == pytest.approx([0, 0], abs=1e-9)
        foot = placed[placed[:, 2] < 1e-4, :2]
        assert (foot.min(axis=0) < 1e-4).all() and (foot.max(axis=0) > -1e-4).all()
