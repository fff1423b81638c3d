"""Synthesised grasps: every promise checked anew, by other means than those that made them."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.contact_frame import place, project
from dexgrasp.dataset.proposals import Approach, Contact
from dexgrasp.dataset.surface import Surface
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import rotation_angle
from dexgrasp.objects import Object
from dexgrasp.quality import epsilon, wrenches

SETTINGS = SynthesisSettings(batch=4096, rounds=6, target=150)


def body(mesh: trimesh.Trimesh, name: str) -> Object:
    return Object(name, "test", mesh, (mesh.convex_hull,))


@pytest.fixture(scope="module")
def can():
    return body(trimesh.creation.cylinder(0.033, 0.11, sections=48), "can")


@pytest.fixture(scope="module")
def made(hand, can):
    return synthesize(hand, can, SETTINGS, 0)


def test_grasps_are_found_and_counted(made):
    grasps, summary = made
    assert len(grasps) == summary.kept > 20
    assert summary.note == ""
    # Every candidate is either valid or rejected once.
    assert summary.candidates == summary.valid + sum(summary.rejected.values())
    assert summary.kept <= summary.distinct <= summary.valid


def test_every_finger_touches_the_surface(made, can):
    grasps, _ = made
    field = DistanceField.build(can.mesh)
    assert not grasps.contacts.isnan().any()
    assert field.distance(grasps.contacts.reshape(-1, 3)).abs().max() < 1e-9


def test_quality_is_the_epsilon_of_the_contacts(made, can):
    grasps, _ = made
    again = epsilon(wrenches(grasps.contacts, grasps.normals, can.com, can.radius, 0.5, 8))
    torch.testing.assert_close(again, grasps.quality)
    assert grasps.quality.min() >= SETTINGS.epsilon


def test_nothing_penetrates_at_grasp_and_on_the_way(made, hand, can):
    grasps, _ = made
    field, shape = DistanceField.build(can.mesh), HandShape(hand)
    assert shape.object_distance(field, grasps.pose, grasps.joints).min() > -SETTINGS.penetration
    for retreat in (0.0, 0.02, 0.05, 0.1):
        pose, joints = pregrasp(hand, grasps, retreat, SETTINGS.opening)
        assert shape.object_distance(field, pose, joints).min() > -SETTINGS.overlap - 1e-4
        assert not shape.self_collision(joints).any()
    assert not shape.self_collision(grasps.joints).any()


def test_closing_again_from_the_pregrasp_gives_the_same_grasp(made, hand, can):
    grasps, _ = made
    _, waiting = pregrasp(hand, grasps)
    closure = Closer(hand).close(DistanceField.build(can.mesh), grasps.pose, waiting)
    assert closure.on_tip.all()
    assert (closure.joints - grasps.joints).abs().max() < 5e-3


def test_the_hand_stays_above_the_table_in_some_resting_pose(made, hand, can):
    grasps, _ = made
    shape = HandShape(hand)
    poses, _ = can.stable
    heights = torch.stack([shape.table_distance(torch.from_numpy(p) @ grasps.pose, grasps.joints) for p in poses])
    assert (heights.max(dim=0).values >= SETTINGS.table - 1e-9).all()


def test_the_telling_finger_is_the_one_that_loses_least(made, hand):
    grasps, _ = made

    def moved(finger):
        rows = torch.arange(len(grasps))
        points, normals = grasps.contacts[rows, finger], grasps.normals[rows, finger]
        xy, known = project(hand, finger, points, normals, grasps.pose, grasps.joints)
        away = (place(hand, finger, points, normals, xy, grasps.joints) - grasps.pose)[:, :3, 3].norm(dim=1)
        return torch.where(known, away, torch.inf)

    chosen = moved(grasps.finger)
    fixed = moved(torch.zeros_like(grasps.finger))
    assert chosen.median() < 2e-3
    assert chosen.median() <= fixed.median()


def test_grasps_are_distinct_and_spread(made, can):
    grasps, _ = made
    keys = torch.cat([grasps.pose.flatten(1), grasps.joints], dim=1)
    distance = torch.cdist(keys, keys, compute_mode="donot_use_mm_for_euclid_dist")
    distance.fill_diagonal_(1)
    assert distance.min() > 1e-3
    azimuth = torch.atan2(grasps.contacts[:, 0, 1], grasps.contacts[:, 0, 0])
    assert torch.histc(azimuth, 6, -np.pi, np.pi).min() > 0


def test_same_seed_same_grasps(hand, can, made):
    again, summary = synthesize(hand, can, SETTINGS, 0)
    assert summary == made[1]
    for name, value in again.tensors().items():
        assert torch.equal(value, made[0].tensors()[name]), name
    other, _ = synthesize(hand, can, dataclasses.replace(SETTINGS, rounds=1), 1)
    assert not torch.equal(other.pose[:5], again.pose[:5])


def test_an_object_too_large_says_why(hand):
    grasps, summary = synthesize(
        hand,
        body(trimesh.creation.box((0.5, 0.5, 0.5)), "crate"),
        SynthesisSettings(batch=1024, rounds=2),
        0,
    )
    assert len(grasps) == 0 and summary.kept == 0
    assert "crate" in summary.note and "misses" in summary.note


@pytest.fixture(scope="module")
def surface(can):
    return Surface.sample(can, DistanceField.build(can.mesh), 0.004, np.random.default_rng(0))


def test_surface_points_lie_on_the_surface_and_leave_nothing_out(surface, can):
    assert surface.field.distance(surface.points).abs().max() < 1e-9
    assert len(surface.points) > 2000  # a small object is sampled more finely than the spacing asks
    anywhere = torch.from_numpy(np.array(trimesh.sample.sample_surface(can.mesh, 500, seed=1)[0]))
    assert (surface.points[surface.nearest(anywhere)] - anywhere).norm(dim=1).max() < 0.006


def test_approach_looks_along_normals_with_open_fingers(hand, surface):
    rng = np.random.default_rng(0)
    proposer = Approach(hand)
    draws = proposer.draw(surface, 400, rng)
    for step in (draws, proposer.vary(surface, draws, 1.0, rng)):
        pose, joints = proposer.hands(surface, step)
        palm = pose @ hand.base_T_palm
        assert (torch.linalg.det(palm[:, :3, :3]) - 1).abs().max() < 1e-9
        assert (palm[:, :3, 2] + surface.normals[step.point]).abs().max() < 1e-9
        assert (joints[:, 1:] == 0).all() and joints[:, 0].std() > 0.5


def test_contact_places_the_fingertip_where_it_says(hand, surface):
    rng = np.random.default_rng(0)
    proposer = Contact(hand)
    draws = proposer.draw(surface, 400, rng)
    assert (np.bincount(draws.finger) >= 133).all()  # every finger in turn
    near = proposer.vary(surface, draws, 1.0, rng)
    for step in (draws, near):
        pose, joints = proposer.hands(surface, step)
        tips = (pose[:, None] @ hand.fingertips(step.joints))[torch.arange(400), step.finger, :3, 3]
        away = (tips - surface.points[step.point]).norm(dim=1)
        torch.testing.assert_close(away, torch.full_like(away, hand.fingers[0].tip_radius))
        assert (joints[:, 1:] == 0).all()
    moved = (surface.points[near.point] - surface.points[draws.point]).norm(dim=1)
    assert 0 < moved.median() < 0.02
    assert (near.joints - draws.joints).abs().max() < 0.6


def test_contact_first_grasps_are_told_exactly(hand):
    """Also where rims and handles get in the way: what was told must be what touches."""
    outer, inner = trimesh.creation.cylinder(0.04, 0.09, sections=48), trimesh.creation.cylinder(0.036, 0.09)
    cup = trimesh.boolean.difference([outer, inner.apply_translation([0, 0, 0.004])], engine="manifold")
    settings = dataclasses.replace(SETTINGS, approach=0.0, resting=None, rounds=8)
    grasps, summary = synthesize(hand, body(cup, "cup"), settings, 0)
    assert len(grasps) >= 100
    rows = torch.arange(len(grasps))
    points, normals = grasps.contacts[rows, grasps.finger], grasps.normals[rows, grasps.finger]
    xy, known = project(hand, grasps.finger, points, normals, grasps.pose, grasps.joints)
    back = place(hand, grasps.finger, points, normals, xy, grasps.joints)
    exact = known & ((back - grasps.pose)[:, :3, 3].norm(dim=1) < 1e-3)
    exact &= rotation_angle(back[:, :3, :3], grasps.pose[:, :3, :3]) < np.deg2rad(1)
    assert exact.double().mean() >= 0.95
    assert summary.exact >= 0.95


def test_settings_are_checked():
    with pytest.raises(DexgraspError, match="shares"):
        SynthesisSettings(approach=1.2)
    with pytest.raises(DexgraspError, match="patience"):
        SynthesisSettings(patience=0)


def test_every_likely_resting_pose_gets_its_share(hand):
    """A flat box mostly lies on a large side; it is not left with the grasps of how it seldom stands."""
    box = body(trimesh.creation.box((0.05, 0.07, 0.09)), "brick")
    grasps, _ = synthesize(hand, box, SynthesisSettings(batch=4096, rounds=8, target=200, epsilon=0.02), 0)
    shape = HandShape(hand)
    _, waiting = pregrasp(hand, grasps, SETTINGS.retreat, SETTINGS.opening)
    poses, likelihoods = box.stable
    for rest, likelihood in zip(poses, likelihoods, strict=True):
        lying = torch.from_numpy(rest) @ grasps.pose
        free = torch.stack([shape.table_distance(lying, j) >= SETTINGS.table for j in (grasps.joints, waiting)]).all(0)
        assert free.sum() >= 0.5 * likelihood * 200
