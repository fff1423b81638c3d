"""Distance fields against closed forms and trimesh."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError


def around(mesh, count=3000, margin=0.02, seed=0):
    unit = np.random.default_rng(seed).uniform(size=(count, 3))
    return mesh.bounds[0] - margin + unit * (mesh.extents + 2 * margin)


def cup() -> trimesh.Trimesh:
    """A box of 60 mm, open at the top, with walls of 1 mm: thinner than the grid's spacing."""
    outer = trimesh.creation.box((0.06, 0.06, 0.06))
    inner = trimesh.creation.box((0.058, 0.058, 0.06))
    inner.apply_translation((0, 0, 0.001))
    return trimesh.boolean.difference([outer, inner], engine="manifold")


MESHES = {
    "sphere": trimesh.creation.icosphere(3, 0.03),
    "box": trimesh.creation.box((0.08, 0.05, 0.02)),
    "torus": trimesh.creation.torus(0.04, 0.01),
    "cup": cup(),
}


@pytest.mark.parametrize("name", MESHES)
def test_nearest_agrees_with_trimesh(name):
    mesh = MESHES[name]
    points = around(mesh, 400)
    distance, point, normal = DistanceField.build(mesh).nearest(points)
    _, expected, _ = trimesh.proximity.closest_point(mesh, points)
    # trimesh rounds at triangle edges by up to 1e-5; a nearer point of the surface is right.
    assert (np.abs(distance) <= expected + 1e-12).all()
    np.testing.assert_allclose(np.abs(distance), expected, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(point - points, axis=1), np.abs(distance), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(points, point + distance[:, None] * normal, atol=1e-9)
    clear = expected > 1e-5
    np.testing.assert_array_equal((distance < 0)[clear], mesh.contains(points)[clear])


def test_box_in_closed_form():
    half = np.array([0.04, 0.025, 0.01])
    points = around(MESHES["box"], 5000)
    beyond = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)
    field = DistanceField.build(MESHES["box"])
    np.testing.assert_allclose(field.nearest(points)[0], expected, atol=1e-12)


@pytest.mark.parametrize("name", MESHES)
def test_the_grid_never_promises_too_much(name):
    mesh = MESHES[name]
    field = DistanceField.build(mesh)
    points = around(mesh, 5000, margin=0.05)
    exact = field.nearest(points)[0]
    slack = exact - field.lower_bound(points)
    assert slack.min() > -1e-12
    assert slack[np.abs(exact) < 0.003].max() < 0.0036  # twice half a cell's diagonal
    assert (
        np.median(slack[(exact > 0.006) & (exact < 0.012)]) < 4e-4
    )  # interpolation's variance over twice the distance
    assert (field.distance(points) <= exact + 1e-12).all()
    inside = (np.abs(points) < mesh.extents / 2).all(1)
    np.testing.assert_allclose(field.distance(points)[inside], exact[inside], atol=1e-12)


def test_the_walls_of_a_thin_cup_have_an_inside():
    field = DistanceField.build(MESHES["cup"])
    heights = np.linspace(-0.02, 0.02, 50)
    wall = np.stack([np.full(50, 0.0295), np.zeros(50), heights], 1)
    np.testing.assert_allclose(field.distance(wall), -0.0005, atol=1e-9)
    hollow = wall - [0.0015, 0, 0]
    np.testing.assert_allclose(field.distance(hollow), 0.001, atol=1e-9)


def test_torch_is_answered_in_torch():
    field = DistanceField.build(MESHES["sphere"])
    points = torch.tensor([[0.05, 0.0, 0.0], [0.0, 0.0, 0.0]])
    distance, _, normal = field.nearest(points)
    assert distance.dtype == torch.float32
    torch.testing.assert_close(distance, torch.tensor([0.02, -0.03]), atol=2e-4, rtol=0)
    torch.testing.assert_close(normal[0], torch.tensor([1.0, 0.0, 0.0]), atol=2e-2, rtol=0)


def test_an_open_mesh_is_refused():
    mesh = MESHES["box"].copy()
    mesh.update_faces(np.arange(11))
    with pytest.raises(DexgraspError, match="watertight"):
        DistanceField.build(mesh)


def test_real_meshes_have_the_right_sign(shared):
    for name in ("025_mug", "gd_cellphone_poisson_008", "040_large_marker"):
        path = next((shared / "data" / "objects").rglob(f"*{name}*.obj"))
        mesh = trimesh.load(path, force="mesh")
        points = around(mesh, 1500)
        distance = DistanceField.build(mesh).distance(points)
        clear = np.abs(distance) > 1e-5
        np.testing.assert_array_equal((distance < 0)[clear], mesh.contains(points)[clear])
