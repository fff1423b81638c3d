"""The Multi-FinGAN planner on a box and a made-up dataset of it: no simulation, no stored data."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from dexgrasp_multifingan.examples import Example, seen_object
from dexgrasp_multifingan.fitting import Fitting, Settings
from dexgrasp_multifingan.losses import contact, orientation, penetration, surface_distance
from dexgrasp_multifingan.networks import Networks
from dexgrasp_multifingan.taxonomy import taxonomy

from dexgrasp.checkpoint import FILE
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.plugins import load_hand, load_planner
from dexgrasp.testing import laws
from dexgrasp.testing.planner_laws import two_boxes

SIDES = (0.06, 0.06, 0.1)
SMALL = {"types": 2, "points": 32, "channels": 16, "hidden": 32}
SETTINGS = Settings(
    steps=60,
    batch=8,
    critic_steps=1,
    learning_rate=0.003,
    adversarial=0.1,
    contact=100.0,
    penetration=20.0,
    orientation=1.0,
    classification=1.0,
    gradient_penalty=10.0,
)


@pytest.fixture(scope="module")
def field() -> DistanceField:
    return DistanceField.build(trimesh.creation.box(SIDES), spacing=0.005)


@pytest.fixture(scope="module")
def example(hand) -> Example:
    """A box on the table as seen from all sides, and hands above it with fingers half closed."""
    points, faces = trimesh.sample.sample_surface(trimesh.creation.box(SIDES), 200, seed=0)
    normals = trimesh.creation.box(SIDES).face_normals[faces]
    points[:, 2] += SIDES[2] / 2
    cloud = torch.from_numpy(np.hstack([points, normals]))
    seen, middle = seen_object(cloud, SMALL["points"], 0, 0)
    object_pose = torch.eye(4)
    object_pose[:3, 3] = torch.tensor([0, 0, SIDES[2] / 2]) - middle
    palm = torch.diag(torch.tensor([1.0, -1, -1, 1])).repeat(40, 1, 1)
    palm[:, 2, 3] = torch.linspace(0.07, 0.09, 40)
    share = torch.linspace(0.3, 0.6, 40)[:, None]
    joints = (hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])).float()
    base = palm @ inverse(hand.base_T_palm.float())
    touching = torch.ones(40, len(hand.fingers), dtype=torch.bool)
    return Example(seen.float(), 0, object_pose.float(), float(middle[2]), base, joints, touching)


def fitted(hand, example, field, **changes) -> tuple[Networks, dict[str, float]]:
    torch.manual_seed(0)
    networks = Networks(hand, SMALL["types"], SMALL["channels"], SMALL["hidden"])
    return networks, Fitting(networks, [example], lambda _: field, replace(SETTINGS, **changes), 0).run()


@pytest.fixture(scope="module")
def trained(hand, example, field):
    return fitted(hand, example, field)


def test_training_brings_fingertips_to_the_object_and_repeats(hand, example, field, trained):
    _, before = fitted(hand, example, field, steps=1, learning_rate=0.0)
    _, after = trained
    assert after["contact"] < 0.7 * before["contact"]
    assert after["classification"] <= before["classification"]
    first, second = (fitted(hand, example, field, steps=3)[0].state_dict() for _ in range(2))
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_losses_are_lengths_of_the_true_surface(field):
    pose = torch.eye(4)[None]
    pose[0, 0, 3] = 1.0
    # 1 cm above the top, 1 cm below it, and off an edge by 3 and 4 mm.
    points = torch.tensor([[[1.0, 0, 0.06], [1.0, 0, 0.04], [1.033, 0, 0.054]]], requires_grad=True)
    found = surface_distance(points, pose, [0], lambda _: field)
    torch.testing.assert_close(found.detach()[0], torch.tensor([0.01, -0.01, 0.005]), atol=1e-5, rtol=0)
    found.sum().backward()
    up = torch.tensor([[0, 0, 1.0], [0, 0, 1.0], [0.6, 0, 0.8]])
    torch.testing.assert_close(points.grad[0], up, atol=1e-3, rtol=0)
    tips = torch.tensor([[[0.02, 0.01], [-0.003, 0.2], [0.5, 0.5]]])
    touching = torch.tensor([[True, True, False]])
    torch.testing.assert_close(contact(tips, touching), torch.tensor([0.0065]))
    inside = penetration(found.detach(), torch.tensor([[0.1, -0.02, 0.1]]))
    torch.testing.assert_close(inside, torch.tensor([0.03]), atol=1e-5, rtol=0)
    palm = torch.diag(torch.tensor([1.0, -1, -1, 1]))[None]
    palm[0, 2, 3] = 0.1
    torch.testing.assert_close(orientation(palm), torch.tensor([0.0]))


def test_types_are_the_postures_that_grasps_have():
    low, high = torch.zeros(30, 2), torch.ones(10, 2)
    joints = torch.cat([low, high]) + 0.01 * torch.arange(40).unsqueeze(1) / 40
    touching = torch.cat([torch.tensor([[True, False]]).repeat(30, 1), torch.ones(10, 2, dtype=torch.bool)])
    types, own = taxonomy(joints, torch.cat([torch.zeros(30, 3), torch.ones(10, 3)]), touching, torch.ones(2), 2, 0)
    assert own[:30].unique().numel() == own[30:].unique().numel() == 1 and own[0] != own[-1]
    assert types.touching[own[0]].tolist() == [True, False] and types.touching[own[-1]].tolist() == [True, True]
    torch.testing.assert_close(types.centre[own[-1]], torch.ones(3))


@pytest.fixture(scope="module")
def planner(hand, trained, tmp_path_factory):
    """Written as `fit` does and loaded as `eval` does."""
    folder = tmp_path_factory.mktemp("multifingan")
    taught = load_planner("multifingan", hand, **SMALL)
    taught.networks = trained[0].eval()
    taught.save(folder)
    # The sizes are those of the weights.
    return load_planner("multifingan", hand, weights=str(folder), samples=64), folder, taught


def test_weights_come_back_and_are_refused_for_another_hand(planner):
    loaded, folder, taught = planner
    own, other = loaded.networks.state_dict(), taught.networks.state_dict()
    assert own.keys() == other.keys() and all(torch.equal(own[key], other[key]) for key in own)
    with pytest.raises(DexgraspError, match="allegro_right"):
        load_planner("multifingan", load_hand("allegro_right"), weights=str(folder / FILE))
    with pytest.raises(DexgraspError, match=r"planner\.weights"):
        load_planner("multifingan", loaded.hand).plan(two_boxes(), 1)
    with pytest.raises(DexgraspError, match="stepz"):
        load_planner("multifingan", loaded.hand, stepz=1)


@pytest.mark.parametrize("law", laws("planner"), ids=lambda law: law.__name__)
def test_it_obeys_the_laws_of_planners(planner, law):
    law(planner[0])


def test_grasps_move_with_the_scene(planner):
    seen = two_boxes()
    world_T_camera = seen.view.world_T_camera.double()
    # Along the table, as the camera sees it.
    slide = inverse(world_T_camera)[:3, :3] @ torch.tensor([0.03, -0.02, 0.0], dtype=torch.float64)
    view = replace(seen.view, points=seen.view.points + slide.to(seen.view.points))
    before = planner[0].plan(seen, 5)
    after = planner[0].plan(replace(seen, view=view), 5)
    assert len(before) == len(after) > 0
    torch.testing.assert_close(after.pose[:, :3, 3], before.pose[:, :3, 3] + slide, atol=2e-3, rtol=0)


def test_each_grasp_tells_the_object_it_is_meant_for(planner):
    view = two_boxes().view
    grasps = planner[0].plan(two_boxes(), 5)
    told = grasps.contacts[torch.arange(len(grasps)), grasps.finger]
    nearest = torch.cdist(told, view.points.double()).min(1)
    assert (nearest.values < 1e-5).all() and (view.instance[nearest.indices] >= 0).all()
