"""The predict command reads clouds of several kinds."""

import numpy as np
import pytest
import trimesh

from dexgrasp.commands.predict import read_cloud
from dexgrasp.errors import DexgraspError

POINTS = np.random.default_rng(0).uniform([0.0, 0.0, 0.5], [1.0, 1.0, 1.5], (50, 3))
NORMALS = np.tile([0.0, 0.0, -1.0], (50, 1))


def test_kinds(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    np.save(tmp_path / "b.npy", np.hstack([POINTS, NORMALS]))
    np.savez(tmp_path / "c.npz", points=POINTS, normals=NORMALS)
    trimesh.PointCloud(POINTS).export(tmp_path / "d.ply")
    for name, has in (("a.npy", False), ("b.npy", True), ("c.npz", True), ("d.ply", False)):
        points, normals = read_cloud(tmp_path / name)
        np.testing.assert_allclose(points, POINTS, atol=1e-6)
        assert (normals is not None) == has
    depth = np.zeros((4, 6))
    depth[1, 2], depth[3, 5] = 0.5, 0.8
    np.savez(tmp_path / "e.npz", depth=depth, K=np.array([[10.0, 0, 2], [0, 20.0, 1], [0, 0, 1]]))
    points, _ = read_cloud(tmp_path / "e.npz")
    np.testing.assert_allclose(points, [[0, 0, 0.5], [0.24, 0.08, 0.8]])


def test_what_cannot_be_read(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"no array")
    (tmp_path / "b.stl").write_bytes(b"")
    np.savez(tmp_path / "c.npz", cloud=POINTS)
    for name, told in (("none.npy", "no file"), ("a.npy", "readable"), ("b.stl", "known kind"), ("c.npz", "rename")):
        with pytest.raises(DexgraspError, match=told):
            read_cloud(tmp_path / name)
