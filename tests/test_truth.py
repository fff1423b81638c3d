"""The checks of told grasps, against closing the hand oneself."""

import dataclasses
import math

import pytest
import torch
import trimesh
from torch.nn.functional import normalize

import dexgrasp
from dexgrasp.closing import Closer
from dexgrasp.dataset.truth import Body, Truth, TruthSettings, deviation
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import axis_angle, inverse, pose
from dexgrasp.grasps import Grasps
from dexgrasp.quality import epsilon, wrenches

RADIUS = 0.035


@pytest.fixture(scope="module")
def closer():
    return Closer(dexgrasp.load_hand("barrett"))


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(3, RADIUS)
    return Body(DistanceField.build(mesh, 0.004), mesh.center_mass, RADIUS, mesh.volume)


@pytest.fixture(scope="module")
def grasps(closer, ball):
    """Valid grasps of the ball, palm towards its centre."""
    hand, count = closer.hand, 120
    generator = torch.Generator().manual_seed(0)
    x, z = normalize(torch.randn(2, count, 3, generator=generator, dtype=torch.float64), dim=-1)
    y = normalize(torch.linalg.cross(z, x), dim=-1)
    away = RADIUS + 0.02 + 0.04 * torch.rand(count, 1, generator=generator).double()
    palm = pose(torch.stack([torch.linalg.cross(y, z), y, z], dim=-1), -away * z)
    joints = torch.zeros(count, 4, dtype=torch.float64)
    joints[:, 0] = torch.rand(count, generator=generator)
    closure = closer.close(ball.field, palm @ inverse(hand.base_T_palm.double()), joints)
    good = (closure.touched & closure.on_tip).all(1) & (closure.penetration <= 1e-3)
    cones = wrenches(closure.contacts[good], closure.normals[good], ball.com, ball.radius)
    base = (palm @ inverse(hand.base_T_palm.double()))[good]
    found = Grasps.build(base, closure.joints[good], 3, quality=epsilon(cones))
    found = found.replace(contacts=closure.contacts[good], normals=closure.normals[good])
    found = found.replace(object=torch.zeros(len(found), dtype=torch.long))[found.quality > 0.1]
    assert len(found) > 10
    return found


def jittered(grasps, distance, angle, seed=1):
    generator = torch.Generator().manual_seed(seed)
    axis, shift = normalize(torch.randn(2, len(grasps), 3, generator=generator, dtype=torch.float64), dim=-1)
    turn = pose(axis_angle(axis, torch.full((len(grasps),), angle, dtype=torch.float64)), distance * shift)
    return grasps.replace(pose=grasps.pose @ turn)


HERE = torch.eye(4, dtype=torch.float64)[None]


def test_deviation_is_the_jitter(grasps):
    distance, angle = deviation(jittered(grasps, 0.01, 0.2), grasps)
    torch.testing.assert_close(distance, torch.full_like(distance, 0.01))
    torch.testing.assert_close(angle, torch.full_like(angle, 0.2))


def test_the_original_holds_without_closing_again(grasps, ball):
    good, quality = Truth(None, [ball], HERE).holds(grasps, grasps)
    assert good.all() and torch.equal(quality, grasps.quality)


def test_small_changes_mostly_hold_and_quality_is_that_of_the_closed_grasp(closer, grasps, ball):
    truth = Truth(closer, [ball], HERE)
    told = jittered(grasps, 0.004, 0.05)
    good, quality = truth.holds(told, grasps)
    assert good.double().mean() > 0.5
    opened = told.joints.clone()
    opened[:, 1:] = (opened[:, 1:] - 0.35).clamp(min=0)
    closure = closer.close(ball.field, told.pose, opened)
    expected = epsilon(wrenches(closure.contacts, closure.normals, ball.com, ball.radius))
    torch.testing.assert_close(quality[good], expected[good])
    allowed = (closure.touched & closure.on_tip).all(1) & (closure.penetration <= 1e-3) & (expected >= 0.05)
    assert torch.equal(good, allowed)
    assert (quality[~good] == 0).all()


def test_hands_beside_the_object_do_not_hold(closer, grasps, ball):
    wide = TruthSettings(distance=1.0, angle=math.pi)
    away = grasps.replace(pose=grasps.pose @ pose(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0, -0.2])))
    assert not Truth(closer, [ball], HERE, wide).holds(away, grasps)[0].any()
    into = grasps.replace(pose=grasps.pose @ pose(torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0, 0.08])))
    assert not Truth(closer, [ball], HERE, wide).holds(into, grasps)[0].any(), "the palm is in the object"


def test_far_ones_are_not_tried(grasps, ball):
    settings = TruthSettings(distance=0.003, angle=1.0)
    assert not Truth(None, [ball], HERE, settings).holds(jittered(grasps, 0.004, 0.05), grasps)[0].any()


def test_frame_and_object_number_do_not_matter(closer, grasps, ball):
    told = jittered(grasps, 0.004, 0.05)
    good, quality = Truth(closer, [ball], HERE).holds(told, grasps)
    motion = jittered(grasps, 0.5, 1.0).pose[0]
    other = motion.clone()
    other[0, 3] += 1
    truth = Truth(closer, [ball, ball], torch.stack([other, motion]))
    number = torch.ones(len(grasps), dtype=torch.long)
    there = truth.holds(told.moved(motion), grasps.moved(motion).replace(object=number))
    assert (there[0] == good).double().mean() > 0.8, "rounding turns normals where a finger touches an edge"
    assert (there[1] - quality).abs().median() < 1e-6
    assert not truth.holds(told.moved(motion), grasps.moved(motion))[0].any(), "object 0 stands elsewhere"


def test_the_scene_has_the_last_word(closer, grasps, ball):
    told = jittered(grasps, 0.004, 0.05)
    free, _ = Truth(closer, [ball], HERE).holds(told, grasps)
    seen = []

    def clear(asked):
        seen.append(asked)
        return torch.arange(len(asked)) % 2 == 0

    good, quality = Truth(closer, [ball], HERE, clear=clear).holds(told, grasps)
    assert len(seen) == 1 and len(seen[0]) == free.sum() and (seen[0].object == 0).all()
    assert torch.equal(good.nonzero(), free.nonzero()[::2]) and (quality[~good] == 0).all()


def test_outcome_says_what_closing_gives(closer, grasps, ball):
    found = Truth(closer, [ball], HERE).outcome(grasps)
    assert found.clear.all() and (found.touched == 3).all()
    torch.testing.assert_close(found.epsilon, grasps.quality, atol=0.05, rtol=0)
    away = grasps.replace(pose=grasps.pose + torch.tensor([0, 0, 0, 1.0, *[0] * 12]).reshape(4, 4))
    found = Truth(closer, [ball], HERE, clear=lambda told: told.quality > 0.2).outcome(away)
    assert torch.equal(found.clear, grasps.quality > 0.2) and (found.touched == 0).all() and (found.epsilon == 0).all()
    nowhere = grasps.replace(object=torch.full_like(grasps.object, -1))
    found = Truth(closer, [ball], HERE).outcome(nowhere)
    assert not found.clear.any() and (found.touched == 0).all() and (found.epsilon == 0).all()


def test_what_is_too_heavy_is_no_label(closer, grasps, ball):
    up = torch.tensor([0.0, 0.0, 1.0])
    held = Truth(closer, [ball], HERE, up=up).outcome(grasps).capacity
    assert (held > 0).all() and held.min() < held.max()
    between = float(held.median())
    told = jittered(grasps, 0.0, 0.0)
    for settings in (TruthSettings(capacity=between), TruthSettings(capacity=between, same_distance=0.0)):
        good, quality = Truth(closer, [ball], HERE, settings, up=up).holds(told, grasps)
        # Closing again moves contacts by microns.
        sure = (held - between).abs() > 0.05 * between
        assert torch.equal(good[sure], (held > between)[sure]) and (quality[~good] == 0).all()
    torch.testing.assert_close(Truth(closer, [ball], HERE, up=up).capacity(grasps), held.double(), rtol=0.05, atol=1e-3)
    heavy = dataclasses.replace(ball, volume=100 * ball.volume)
    lighter = Truth(closer, [heavy], HERE, up=up).outcome(grasps).capacity
    torch.testing.assert_close(lighter * 1.0, held * max(0.05, 500 * ball.volume) / 1.0, rtol=1e-3, atol=1e-6)
