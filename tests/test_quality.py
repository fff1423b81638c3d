"""Epsilon against qhull, closed forms and the values of the real GraspIt! 4."""

import json
import math

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from dexgrasp.errors import DexgraspError
from dexgrasp.quality import epsilon, reaches, volume, wrenches


def grasps(count, fingers, seed=0, tilt=0.3):
    rng = np.random.default_rng(seed)
    contacts = rng.normal(size=(count, fingers, 3))
    contacts /= np.linalg.norm(contacts, axis=-1, keepdims=True)
    normals = contacts + tilt * rng.normal(size=contacts.shape)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return contacts * rng.uniform(0.5, 1, (count, fingers, 1)), normals


def qhull(sets):
    return np.array([max(0.0, -ConvexHull(w).equations[:, -1].max()) for w in sets])


@pytest.mark.parametrize(("fingers", "edges", "count"), [(3, 8, 400), (3, 16, 60), (4, 8, 60), (5, 5, 60), (8, 8, 10)])
def test_epsilon_agrees_with_qhull(fingers, edges, count):
    sets = wrenches(*grasps(count, fingers), np.zeros(3), 1.0, 0.5, edges)
    expected = qhull(sets)
    assert (expected > 0).any()
    np.testing.assert_allclose(epsilon(sets), expected, atol=1e-11)


def test_epsilon_agrees_with_qhull_on_points_without_structure():
    rng = np.random.default_rng(1)
    sets = rng.normal(size=(60, 40, 6)) + 0.3 * rng.normal(size=(60, 1, 6))
    np.testing.assert_allclose(epsilon(sets), qhull(sets), atol=1e-11)


def test_epsilon_of_known_bodies():
    cross = np.concatenate([np.eye(6), -np.eye(6)])
    cube = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 6), -1).reshape(-1, 6)
    assert epsilon(cross[None])[0] == pytest.approx(1 / math.sqrt(6), abs=1e-14)
    assert epsilon(cube[None])[0] == pytest.approx(1.0, abs=1e-12)  # 64 corners: every facet holds 32 of them
    assert epsilon(cube[None] + 0.25)[0] == pytest.approx(0.75, abs=1e-12)


def test_degenerate_sets_give_exactly_zero():
    cross = np.concatenate([np.eye(6), -np.eye(6)])
    flat = cross.copy()
    flat[:, 5] = 0  # rank 5
    half = np.concatenate([cross[:11], np.zeros((1, 6))])  # the origin lies on a facet
    outside = cross + 2
    sets = np.stack([flat, half, outside, np.zeros((12, 6))])
    assert (epsilon(sets) == 0).all()
    assert epsilon(np.zeros((2, 3, 6))).tolist() == [0, 0]
    assert epsilon(np.zeros((2, 0, 6))).tolist() == [0, 0]


def test_two_point_contacts_have_no_epsilon():
    # Point contacts cannot resist a torque about the line through them.
    contacts = np.array([[[1.0, 0, 0], [-1.0, 0, 0]]])
    assert epsilon(wrenches(contacts, contacts, np.zeros(3), 1.0)).tolist() == [0]


def test_repeated_and_shuffled_wrenches_change_nothing():
    sets = wrenches(*grasps(50, 3), np.zeros(3), 1.0)
    order = np.random.default_rng(2).permutation(48) % 24
    np.testing.assert_allclose(epsilon(sets[:, order]), epsilon(sets), atol=2e-11)


def test_threshold_rejects_only_what_lies_below():
    sets = wrenches(*grasps(400, 4), np.zeros(3), 1.0)
    exact = epsilon(sets)
    kept = exact >= 0.05
    assert kept.any() and (~kept & (exact > 0)).any()
    np.testing.assert_array_equal(epsilon(sets, 0.05), np.where(kept, exact, 0))
    np.testing.assert_array_equal(reaches(sets, 0.05), kept)


def test_wrenches_are_forces_in_the_cone_and_their_torques():
    contacts, normals = grasps(5, 3)
    origin = np.array([0.1, -0.2, 0.3])
    sets = wrenches(contacts, normals, origin, 2.0, 0.4, 6).reshape(5, 3, 6, 6)
    force = sets[..., :3]
    np.testing.assert_allclose(np.einsum("nfek,nfk->nfe", force, -normals), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(force, axis=-1), math.hypot(1, 0.4), atol=1e-12)
    np.testing.assert_allclose(force.mean(2), -normals, atol=1e-12)
    np.testing.assert_allclose(sets[..., 3:], np.cross((contacts - origin)[:, :, None] / 2, force), atol=1e-12)


def test_an_untouched_finger_adds_nothing():
    contacts, normals = grasps(20, 4, tilt=0.1)
    missing = contacts.copy()
    missing[:, 3] = np.nan
    np.testing.assert_allclose(
        epsilon(wrenches(missing, normals, np.zeros(3), 1.0)),
        epsilon(wrenches(contacts[:, :3], normals[:, :3], np.zeros(3), 1.0)),
        atol=1e-12,
    )


def test_tensors_in_tensors_out():
    contacts, normals = (torch.from_numpy(a) for a in grasps(5, 4))
    sets = wrenches(contacts, normals, torch.zeros(3), 1.0)
    assert sets.dtype == torch.float64
    torch.testing.assert_close(epsilon(sets), torch.from_numpy(epsilon(sets.numpy())))
    assert epsilon(sets.float()).dtype == torch.float32


def test_bad_input_is_told():
    with pytest.raises(DexgraspError, match="shape"):
        epsilon(np.zeros((3, 6)))
    with pytest.raises(DexgraspError, match="finite"):
        epsilon(np.full((1, 8, 6), np.nan))
    with pytest.raises(DexgraspError, match="scale"):
        wrenches(np.zeros((1, 3, 3)), np.zeros((1, 3, 3)), np.zeros(3), 0.0)


def test_golden_values_of_graspit(shared):
    """Two values differ by 6e-5 and 2e-5: facets that GraspIt! merged. |epsilon| < 1e-6 counts as zero."""
    golden = json.loads((shared / "data" / "graspit" / "golden_autograsp.json").read_text())
    differences = []
    for grasp in golden:
        sets = np.array([[wrench for contact in grasp["contacts"] for wrench in contact["wrenches"]]])
        expected = grasp["epsilon_L1"] if grasp["epsilon_L1"] > 1e-6 else 0.0
        assert expected or epsilon(sets)[0] == 0
        differences.append(abs(epsilon(sets)[0] - expected))
        if len(grasp["contacts"]) < 8:
            assert volume(sets)[0] == pytest.approx(grasp["volume_L1"], rel=0.01, abs=1e-9)
    assert sum(g["epsilon_L1"] > 0 for g in golden) == 67
    differences = np.sort(differences)
    assert differences[-3] < 1e-9
    assert differences[-1] < 1e-4


def test_wrenches_reproduce_those_of_graspit(shared):
    golden = json.loads((shared / "data" / "graspit" / "golden_autograsp.json").read_text())
    for grasp in golden:
        if not grasp["contacts"]:
            continue
        contacts = np.array([[c["object_point"] for c in grasp["contacts"]]])
        normals = -np.array([[c["object_inward_normal"] for c in grasp["contacts"]]])
        mu = grasp["contacts"][0]["mu"]
        ours = wrenches(contacts, normals, np.array(grasp["cog"]), grasp["max_radius"], mu).reshape(-1, 8, 6)
        theirs = np.array([c["wrenches"] for c in grasp["contacts"]])
        # The same cones: their axes agree; where the edges start is a choice.
        np.testing.assert_allclose(ours.mean(1), theirs.mean(1), atol=1e-5)
