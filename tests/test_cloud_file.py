"""Clouds from files: what was written comes back in metres, and what is no cloud is refused."""

import numpy as np
import pytest
import trimesh

from dexgrasp.cloud_file import read_cloud
from dexgrasp.errors import DexgraspError

POINTS = np.random.default_rng(0).uniform(-0.2, 0.6, (50, 3)).astype(np.float32)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


def pcd(path, mode, normals):
    fields = ["x", "y", "z", "rgb", *(["normal_x", "normal_y", "normal_z"] if normals else [])]
    rows = np.hstack([POINTS, np.zeros((50, 1), np.float32), *([NORMALS] if normals else [])]).astype(np.float32)
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(fields)}\nSIZE {' '.join('4' * len(fields))}\n"
        f"TYPE {' '.join('F' * len(fields))}\nCOUNT {' '.join('1' * len(fields))}\nWIDTH 50\nHEIGHT 1\nPOINTS 50\n"
        f"DATA {mode}\n"
    )
    body = rows.tobytes() if mode == "binary" else "\n".join(" ".join(map(repr, map(float, r))) for r in rows).encode()
    path.write_bytes(header.encode() + body)


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("kind", ["ply", "npy", "npz", "ascii", "binary"])
def test_clouds_come_back(tmp_path, kind, normals):
    path = tmp_path / {"ascii": "a.pcd", "binary": "b.pcd"}.get(kind, f"cloud.{kind}")
    if kind == "ply":
        header = "ply\nformat ascii 1.0\nelement vertex 50\n"
        axes = ["x", "y", "z", *(["nx", "ny", "nz"] if normals else [])]
        rows = np.hstack([POINTS, NORMALS]) if normals else POINTS
        lines = [" ".join(map(repr, map(float, row))) for row in rows]
        path.write_text(header + "".join(f"property float {a}\n" for a in axes) + "end_header\n" + "\n".join(lines))
    elif kind == "npy":
        np.save(path, np.hstack([POINTS, NORMALS]) if normals else POINTS)
    elif kind == "npz":
        np.savez(path, points=POINTS, **({"normals": NORMALS} if normals else {}))
    else:
        pcd(path, kind, normals)
    capture = read_cloud(path)
    points, found = capture.points, capture.normals
    np.testing.assert_allclose(points, POINTS, atol=1e-6)
    assert (found is not None) == normals
    if found is not None:
        np.testing.assert_allclose(found, NORMALS, atol=1e-6)
    np.testing.assert_allclose(read_cloud(path, scale=0.001).points, POINTS / 1000, atol=1e-9)


def test_ply_meshes_give_their_vertices(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.export(tmp_path / "box.ply")
    np.testing.assert_allclose(read_cloud(tmp_path / "box.ply").points, box.vertices, atol=1e-6)


def test_depth_images_become_points_in_front_of_the_camera(tmp_path):
    depth = np.zeros((4, 5))
    depth[1, 2], depth[3, 4], depth[0, 0] = 0.5, 2.0, np.nan
    camera = np.array([[100.0, 0, 2], [0, 100, 1], [0, 0, 1]])
    np.savez(tmp_path / "view.npz", depth=depth, K=camera)
    capture = read_cloud(tmp_path / "view.npz")
    assert capture.normals is None and capture.shape == (4, 5) and capture.rows.tolist() == [7, 19]
    np.testing.assert_allclose(capture.points, [[0, 0, 0.5], [0.04, 0.04, 2.0]])


def test_points_without_depth_are_left_out(tmp_path):
    rows = POINTS.copy()
    rows[:7] = np.nan
    np.save(tmp_path / "a.npy", rows)
    assert len(read_cloud(tmp_path / "a.npy")) == 43


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"", "convert"),
        ("a.npy", b"not an array", "readable .npy"),
        ("a.npz", b"PK", "readable .npz"),
        ("a.ply", b"ply\nformat", "readable .ply"),
        ("a.pcd", b"VERSION 0.7\nDATA binary_compressed\n", "readable .pcd"),
        ("a.pcd", b"no header at all", "readable .pcd"),
    ],
)
def test_files_that_are_no_cloud_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DexgraspError, match=message):
        read_cloud(tmp_path / name)
    with pytest.raises(DexgraspError):
        read_cloud(tmp_path / "none" / name)


def test_public_scenes_are_read(shared):
    scenes = shared / "data/real_scenes"
    assert len(read_cloud(scenes / "gpd_pcd/table_mug.pcd")) == 104444
    # The same image as compressed PCD and as whole tenths of a millimetre.
    cloud, image = (read_cloud(scenes / f"mosd_kinect/test31.{kind}") for kind in ("pcd", "npz"))
    assert cloud.shape == image.shape == (480, 640) and np.array_equal(cloud.rows, image.rows)
    np.testing.assert_allclose(cloud.points, image.points, atol=2e-4)


@pytest.mark.parametrize("name", ["gone", "gone.ply"])
def test_a_file_that_is_not_there_is_said_to_be_missing(tmp_path, name):
    with pytest.raises(DexgraspError, match=f"no file .*{name}"):
        read_cloud(tmp_path / name)
