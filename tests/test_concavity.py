"""Things that touch are told apart, and one thing stays one."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.cloud import prepare
from dexgrasp.concavity import pieces
from dexgrasp.segmentation import clusters
from dexgrasp.table import find_tabletop

SCENES = Path(__file__).parents[2] / "shared" / "data" / "real_scenes" / "mosd_kinect"


def seen(meshes, noise=0.0):
    """Points of the meshes that an eye above and in front of them sees, 3 mm apart or less, their normals and mesh."""
    whole = trimesh.util.concatenate(meshes)
    points, face = trimesh.sample.sample_surface_even(whole, 12000, seed=0)
    normals = whole.face_normals[face]
    eye = np.array([0.0, -0.5, 0.6])
    inside = [mesh.contains(points - 1e-5 * normals) for mesh in meshes]
    front = ((eye - points) * normals).sum(axis=1) > 0
    hidden = np.zeros(len(points), dtype=bool)
    for mesh in meshes:
        hidden |= mesh.ray.intersects_any(points + 1e-4 * normals, eye - points)
    shown = front & ~hidden
    generator = np.random.default_rng(0)
    points = points[shown] + noise * generator.normal(size=(shown.sum(), 3))
    tilted = normals[shown] + 10 * noise * generator.normal(size=(shown.sum(), 3))
    return points, tilted / np.linalg.norm(tilted, axis=1, keepdims=True), np.argmax(np.array(inside)[:, shown], axis=0)


def ball(x, radius):
    return trimesh.creation.icosphere(3, radius).apply_translation([x, 0, radius])


def box(x, y, size):
    return trimesh.creation.box(size).apply_translation([x, y, size[2] / 2])


@pytest.mark.parametrize("noise", [0.0, 0.0005])
@pytest.mark.parametrize(
    "meshes",
    [
        [ball(-0.03, 0.03), ball(0.0301, 0.03)],
        [box(-0.04, 0, [0.08, 0.05, 0.10]), ball(0.0301, 0.03)],
        [box(0, 0, [0.12, 0.12, 0.03]), ball(0.0, 0.03).apply_translation([0, 0, 0.03])],
    ],
    ids=["two balls", "box and ball", "ball on a box"],
)
def test_things_that_touch_are_told_apart(meshes, noise):
    points, normals, owner = seen(meshes, noise)
    eye = np.eye(4)
    assert clusters(points, eye).max() == 0, "they hang together"
    labels = clusters(points, eye, normals)
    inside = labels >= 0
    assert labels.max() == 1
    agree = np.mean((labels == owner)[inside])
    assert max(agree, 1 - agree) > 0.9


@pytest.mark.parametrize("noise", [0.0, 0.0005])
@pytest.mark.parametrize(
    "mesh",
    [
        ball(0.0, 0.04),
        box(0, 0, [0.15, 0.08, 0.06]),
        trimesh.creation.cylinder(0.035, 0.12).apply_translation([0, 0, 0.06]),
        trimesh.creation.annulus(0.05, 0.055, 0.06).apply_translation([0, 0, 0.03]),
    ],
    ids=["ball", "box", "can", "ring"],
)
def test_one_thing_stays_one(mesh, noise):
    points, normals, _ = seen([mesh], noise)
    assert clusters(points, np.eye(4), normals).max() == 0


def test_too_few_points_are_one_piece():
    points = np.random.default_rng(0).uniform(size=(30, 3)) * 0.02
    assert (pieces(points, np.tile([0.0, 0.0, 1.0], (30, 1)), 40) == 0).all()
    apart = np.arange(100)[:, None] * np.array([[1.0, 0.0, 0.0]])
    assert (pieces(apart, np.tile([0.0, 0.0, 1.0], (100, 1)), 40) == 0).all(), "nobody has a neighbour"


@pytest.mark.skipif(not SCENES.exists(), reason=f"no labelled real scenes at {SCENES}")
def test_more_of_the_things_in_real_scenes_are_found():
    found = np.zeros((2, 2))
    for path in sorted(SCENES.glob("*.npz"))[:4]:
        with np.load(path) as scene:
            depth, matrix, known = scene["depth_0p1mm"] * 1e-4, scene["K"], scene["label"].astype(int)
        v, u = np.nonzero((depth > 0.3) & (depth < 1.6))
        chosen = np.random.default_rng(0).permutation(len(v))[:30000]
        v, u = v[chosen], u[chosen]
        far = depth[v, u]
        sides = (u - matrix[0, 2]) * far / matrix[0, 0], (v - matrix[1, 2]) * far / matrix[1, 1]
        cloud = prepare(np.stack([*sides, far], axis=1).astype(np.float32), None, 30000, 0)
        table = find_tabletop(cloud, 0)
        points, normals = cloud.double().split(3, dim=1)
        pixel = points[:, :2] / points[:, 2:] @ torch.from_numpy(matrix[:2, :2]).T + torch.from_numpy(matrix[:2, 2])
        truth = known[tuple(pixel.round().long().flip(1).T.numpy())]
        at = None if table is None else table.numpy()
        for row, given in enumerate((None, normals.numpy())):
            labels = clusters(points.numpy(), at, given)
            for number in np.unique(truth[truth > 0]):
                own = truth == number
                if own.sum() >= 150:
                    told = np.bincount(labels[own & (labels >= 0)], minlength=1).argmax()
                    found[row] += [(own & (labels == told)).sum() / (own | (labels == told)).sum() > 0.5, 1]
    without, parted = found[:, 0] / found[:, 1]
    assert parted > without + 0.1 and parted > 0.7
