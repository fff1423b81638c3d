"""Wrench models travel with their figures; soft fingers; epsilon's gradient and its bound."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from dexgrasp.errors import DexgraspError
from dexgrasp.quality import epsilon, volume, wrenches
from dexgrasp.quality_gradient import differentiable_epsilon, epsilon_bound, support_directions
from dexgrasp.seeds import stream
from dexgrasp.wrench_model import WrenchModel


def grasps(count, fingers, key="model"):
    rng = stream(0, key, fingers)
    contacts = rng.normal(size=(count, fingers, 3))
    contacts /= np.linalg.norm(contacts, axis=-1, keepdims=True)
    normals = contacts + 0.2 * rng.normal(size=contacts.shape)
    return 0.1 * contacts + 0.02, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


MODEL = WrenchModel((0.02, 0.02, 0.02), 0.1, friction=0.6, edges=7)


def test_a_model_gives_what_the_functions_give():
    contacts, normals = grasps(50, 4)
    sets = wrenches(contacts, normals, np.full(3, 0.02), 0.1, 0.6, 7)
    np.testing.assert_array_equal(MODEL.wrenches(contacts, normals), sets)
    told = MODEL.epsilon(contacts, normals)
    assert told.model == MODEL
    assert (told.values > 0).any()
    np.testing.assert_array_equal(told.values, epsilon(sets))
    np.testing.assert_array_equal(MODEL.reaches(contacts, normals, 0.05), told.values >= 0.05)
    np.testing.assert_array_equal(MODEL.epsilon(contacts, normals, 0.05).values, told.values * (told.values >= 0.05))
    np.testing.assert_array_equal(MODEL.volume(contacts, normals).values, volume(sets))
    summed = WrenchModel(MODEL.origin, 0.1, 0.6, 7, hull="linf").epsilon(contacts, normals).values
    np.testing.assert_array_equal(summed, epsilon(sets, contacts=4))
    assert (summed >= told.values - 1e-11).all()


def test_a_figure_is_stored_with_its_model():
    told = WrenchModel(np.array([0.0, 1, 2]), 2, torsion=0.01, hull="linf").epsilon(*grasps(2, 3), threshold=0.02)
    stored = json.loads(json.dumps(told.as_dict()))
    assert (stored["metric"], stored["threshold"]) == ("epsilon", 0.02)
    again = WrenchModel.from_dict(stored["model"])
    assert again == told.model and hash(again) == hash(told.model)
    assert again != WrenchModel((0, 1, 2), 2, torsion=0.01)


@pytest.mark.parametrize(
    "wrong",
    [
        {"scale": 0.0},
        {"scale": np.nan},
        {"origin": (0, 0)},
        {"friction": -1},
        {"edges": 2},
        {"torsion": -1},
        {"hull": 2},
    ],
)
def test_a_senseless_model_is_told(wrong):
    with pytest.raises(DexgraspError, match="wrench model"):
        WrenchModel(**{"origin": (0, 0, 0), "scale": 1.0} | wrong)


def test_soft_fingers_fill_their_ellipsoid():
    contacts, normals = grasps(5, 3)
    model = WrenchModel((0, 0, 0), 0.1, friction=0.4, edges=8, torsion=0.03)
    sets = model.wrenches(contacts, normals).reshape(5, 3, model.per_contact, 6)
    inward = -normals[:, :, None]
    force, torque = sets[..., :3], sets[..., 3:]
    np.testing.assert_allclose((force * inward).sum(-1), 1, atol=1e-12)
    own = torque - np.cross(contacts[:, :, None] / 0.1, force)  # about the normal
    np.testing.assert_allclose(np.cross(own, np.broadcast_to(inward, own.shape)), 0, atol=1e-12)
    tangent = np.linalg.norm(force - inward, axis=-1) / 0.4
    turn = (own * inward).sum(-1) * 0.1 / 0.03
    np.testing.assert_allclose(tangent**2 + turn**2, 1, atol=1e-12)


def test_soft_fingers_without_torsion_are_hard_and_two_of_them_close():
    contacts, normals = grasps(20, 3)
    hard = WrenchModel((0, 0, 0), 0.1).wrenches(contacts, normals)
    np.testing.assert_array_equal(WrenchModel((0, 0, 0), 0.1, torsion=0.0).wrenches(contacts, normals), hard)
    weak = WrenchModel((0, 0, 0), 0.1, torsion=1e-9)
    np.testing.assert_allclose(
        weak.epsilon(contacts, normals).values, WrenchModel((0, 0, 0), 0.1).epsilon(contacts, normals).values, atol=1e-7
    )
    pair = np.array([[[0.1, 0, 0], [-0.1, 0, 0]]])
    out = pair / 0.1
    assert WrenchModel((0, 0, 0), 0.1).epsilon(pair, out).values.tolist() == [0.0]
    soft = WrenchModel((0, 0, 0), 0.1, torsion=0.02)
    hull = ConvexHull(soft.wrenches(pair, out)[0])
    assert soft.epsilon(pair, out).values[0] == pytest.approx(-hull.equations[:, -1].max(), abs=1e-11)
    assert soft.epsilon(pair, out).values[0] > 0.05


@pytest.mark.parametrize("torsion", [0.0, 0.02])
def test_compiled_and_differentiable_wrenches_agree(torsion):
    contacts, normals = grasps(20, 3)
    contacts[3, 1] = np.nan
    model = WrenchModel((0.01, 0, 0), 0.1, torsion=torsion)
    tensors = torch.from_numpy(contacts).requires_grad_(), torch.from_numpy(normals)
    np.testing.assert_allclose(model.wrenches(*tensors).detach(), model.wrenches(contacts, normals), atol=1e-14)
    assert model.wrenches(tensors[0].detach().float(), tensors[1].float()).dtype == torch.float32
    assert not model.wrenches(contacts, normals)[3, model.per_contact : 2 * model.per_contact].any()


def test_gradient_of_epsilon_with_respect_to_contacts_and_normals():
    contacts, normals = grasps(60, 4)
    model = WrenchModel((0.2, 0.2, 0.2), 1.0)
    good = model.epsilon(10 * contacts, normals).values > 0.01
    assert good.sum() >= 10
    leaves = [torch.from_numpy(a[good][:10]).requires_grad_() for a in (10 * contacts, normals)]

    def value(points, outward):
        return differentiable_epsilon(model.wrenches(points, outward))

    np.testing.assert_allclose(value(*leaves).detach(), epsilon(model.wrenches(*leaves)).detach(), atol=1e-13)
    assert torch.autograd.gradcheck(value, leaves, eps=1e-6, atol=1e-5)


def test_descent_on_the_gradient_reaches_closure():
    contacts, normals = grasps(40, 3)
    model = WrenchModel((0.2, 0.2, 0.2), 1.0)
    none = model.epsilon(10 * contacts, normals).values == 0
    free = torch.from_numpy(10 * contacts[none]).requires_grad_()
    optimiser = torch.optim.Adam([free], lr=0.05)
    for _ in range(100):
        out = torch.nn.functional.normalize(free - 0.2, dim=-1)  # contacts on a ball
        loss = -differentiable_epsilon(model.wrenches(0.2 + out, out)).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    out = torch.nn.functional.normalize(free.detach() - 0.2, dim=-1)
    assert (model.epsilon(0.2 + out, out).values > 0.02).double().mean() > 0.9


def test_bound_is_above_epsilon_and_differentiable():
    sets = torch.from_numpy(MODEL.wrenches(*grasps(200, 4)))
    exact = epsilon(sets)
    closed = exact > 0.01
    rough = torch.nn.functional.normalize(torch.randn(64, 6, generator=torch.Generator().manual_seed(0)), dim=1)
    directions = support_directions(sets)
    assert (epsilon_bound(sets, rough) >= exact - 1e-9)[exact > 0].all()
    tight = epsilon_bound(sets, directions)
    assert (tight >= exact - 1e-12)[exact > 0].all()
    assert (tight / exact)[closed].median() < 1.1
    assert ((tight <= 0) | (exact > 0)).double().mean() > 0.9
    few = sets[:5].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda w: epsilon_bound(w, directions[:5]), few, eps=1e-7, atol=1e-6)
    assert (epsilon_bound(sets, directions, contacts=4) >= epsilon(sets, contacts=4) - 1e-9).all()
    assert epsilon_bound(sets.float(), directions).dtype == torch.float32
