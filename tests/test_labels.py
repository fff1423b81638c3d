"""Which points are labelled, by which grasp, and that what is told there is true."""

import math

import pytest
import torch
from dexgrasp_contact import Contact
from dexgrasp_pose import Pose
from torch.nn.functional import normalize

from dexgrasp.contact_frame import contact_frame, place
from dexgrasp.dataset.labels import LabelSettings, label, near_pairs
from dexgrasp.dataset.truth import Truth, TruthSettings, deviation
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps
from dexgrasp.sampling import farthest_points
from dexgrasp.scene import View

CENTRE, RADIUS = torch.tensor([0.02, -0.01, 0.5]), 0.03


def spiral(count):
    """Nearly uniform unit vectors."""
    index = torch.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, math.pi * (1 + 5**0.5) * index
    return torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], dim=-1)


def ball_view(count=1500, noise=0.0):
    """The side of a ball that faces the camera, and as many points of the table behind it."""
    normals = spiral(2 * count)
    normals = normals[normals[:, 2] < 0]
    table = torch.rand(len(normals), 3, generator=torch.Generator().manual_seed(3)) * 0.1 + torch.tensor([0, 0, 0.55])
    facing = torch.tensor([0.0, 0, -1]).expand(len(normals), 3)
    estimated = normals + noise * torch.randn(normals.shape, generator=torch.Generator().manual_seed(4))
    return View(
        points=torch.cat([CENTRE + RADIUS * normals, table]),
        normals=normalize(torch.cat([estimated, facing]), dim=-1),
        instance=torch.cat([torch.zeros(len(normals)), -torch.ones(len(normals))]).long(),
        world_T_camera=torch.eye(4),
    )


def ball_grasps(hand, count=200, seed=0, tilt=0.0):
    """Grasps of which one finger touches the ball; `tilt` (rad) leans the hand over, off the manifold."""
    generator = torch.Generator().manual_seed(seed)
    normals = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    points, finger = CENTRE + RADIUS * normals, torch.arange(count) % 3
    xy = 1.2 * torch.rand(count, 2, generator=generator) - 0.6
    limits = hand.limits.float()
    joints = limits[:, 0] + torch.rand(count, 6, generator=generator) * (limits[:, 1] - limits[:, 0])
    base = place(hand, finger, points, normals, xy, joints)
    turn = axis_angle(contact_frame(normals)[..., 0], torch.full((count,), tilt))
    lever = (turn @ (base[:, :3, 3] - points).unsqueeze(-1)).squeeze(-1)
    base = pose(turn @ base[:, :3, :3], points + lever)
    grasps = Grasps.build(base, joints, 3, finger=finger, quality=torch.rand(count, generator=generator))
    contacts, outward = grasps.contacts.clone(), grasps.normals.clone()
    contacts[torch.arange(count), finger], outward[torch.arange(count), finger] = points, normals
    return grasps.replace(contacts=contacts, normals=outward, object=torch.zeros(count, dtype=torch.long))


ALL = LabelSettings(points=None)


def near(distance=0.01, degrees=8.0):
    return Truth(None, [], torch.eye(4)[None], TruthSettings(distance, math.radians(degrees), close=False)).holds


@pytest.fixture(scope="module")
def contact(toy_hand):
    return Contact(toy_hand, 16)


def test_pairs_are_near_face_the_same_way_and_share_the_object(toy_hand):
    view, grasps = ball_view(), ball_grasps(toy_hand)
    settings = ALL
    point, contact = near_pairs(view, grasps, settings)
    touched = grasps.contacts.flatten(0, 1)[contact]
    assert len(point) > 100
    assert (view.points[point] - touched).norm(dim=-1).max() <= settings.distance
    cosine = (view.normals[point] * grasps.normals.flatten(0, 1)[contact]).sum(-1)
    assert cosine.min() >= math.cos(settings.angle) - 1e-6
    assert (view.instance[point] == 0).all()
    brute = (view.points[:, None] - grasps.contacts.flatten(0, 1)[None]).norm(dim=-1) <= settings.distance
    brute &= view.normals @ grasps.normals.flatten(0, 1).T >= math.cos(settings.angle)
    brute &= (view.instance == 0)[:, None]
    assert set(zip(point.tolist(), contact.tolist(), strict=True)) == set(map(tuple, brute.nonzero().tolist()))
    other = grasps.replace(object=torch.ones_like(grasps.object))
    assert len(near_pairs(view, other, settings)[0]) == 0


def test_every_true_label_tells_a_grasp_near_its_original(contact, toy_hand):
    view, grasps = ball_view(noise=0.02), ball_grasps(toy_hand)
    labels = label(view, grasps, contact, near(), ALL)
    told = labels.true
    assert 0.2 < told.sum() / (labels.finger > 0).sum() <= 1
    assert not told[labels.finger == 0].any() and (labels.grasp[labels.finger == 0] == -1).all()
    targets = labels.targets(len(view))
    at = labels.point[told]
    decoded = contact.decode(view.points[at], view.normals[at], contact.as_prediction(targets[at]))
    distance, angle = deviation(decoded, grasps[labels.grasp[told].long()])
    assert distance.max() <= 0.01 and angle.max() <= math.radians(8)
    assert (decoded.finger == grasps.finger[labels.grasp[told].long()]).all()


def test_the_best_true_pair_labels_the_point(contact, toy_hand):
    view, grasps = ball_view(noise=0.02), ball_grasps(toy_hand, 400)
    settings = LabelSettings(tries=1000, points=None)
    labels = label(view, grasps, contact, near(), settings)
    point, pair = (torch.from_numpy(part) for part in near_pairs(view, grasps, settings))
    original = grasps[pair // 3].replace(finger=pair % 3)
    targets = contact.encode(view.points[point], view.normals[point], original)
    decoded = contact.decode(view.points[point], view.normals[point], contact.as_prediction(targets))
    good = near()(decoded, original)[0] & targets.encodable
    expected = torch.zeros(len(view))
    for row, quality in zip(point[good].tolist(), original.quality[good].tolist(), strict=True):
        expected[row] = max(expected[row], quality)
    found = torch.zeros(len(view))
    found[labels.point] = labels.quality
    torch.testing.assert_close(found, expected)
    assert (labels.point[labels.finger > 0] == point.unique()).all()
    assert (labels.point == torch.arange(len(view))).all()
    few = label(view, grasps, contact, near(), LabelSettings(tries=2, points=None))
    assert few.true.sum() < labels.true.sum()


def test_worth_says_which_grasp_labels_a_point(contact, toy_hand):
    view, grasps = ball_view(noise=0.02), ball_grasps(toy_hand, 400)
    settings = LabelSettings(tries=1000, points=None, support=False)
    by_quality = label(view, grasps, contact, near(), settings)
    same = label(view, grasps, contact, near(), settings, worth=3 * grasps.quality)
    other = label(view, grasps, contact, near(), settings, worth=1 - grasps.quality)
    assert torch.equal(same.grasp, by_quality.grasp)
    told = by_quality.true
    assert torch.equal(other.true, told)
    assert (other.quality[told] <= by_quality.quality[told]).all()
    assert other.quality[told].mean() < by_quality.quality[told].mean()
    with pytest.raises(DexgraspError, match="capacity or epsilon"):
        LabelSettings(worth="beauty")


def test_grasps_off_the_manifold_are_dropped_by_contact_and_kept_by_pose(contact, toy_hand):
    view, grasps = ball_view(), ball_grasps(toy_hand, tilt=0.5)
    lossy, exact = (label(view, grasps, model, near(), ALL) for model in (contact, Pose(toy_hand, 16)))
    assert lossy.true.sum() < 0.2 * (lossy.finger > 0).sum()
    assert torch.equal(exact.true, exact.finger > 0)
    strict = Truth(None, [], torch.eye(4)[None], TruthSettings(1e-6, 1e-3, close=False)).holds
    assert torch.equal(label(view, grasps, Pose(toy_hand, 16), strict, ALL).true, exact.true)


def test_targets_of_failed_points(contact, toy_hand):
    view = ball_view()
    labels = label(view, ball_grasps(toy_hand, tilt=0.2), contact, near(), ALL)
    failed = labels.point[(labels.finger > 0) & ~labels.true].long()
    assert 0 < len(failed) < (labels.finger > 0).sum()
    negative, ignored = labels.targets(len(view)), labels.targets(len(view), failed="ignored")
    assert (negative.finger[failed] == 0).all() and negative.encodable.all()
    assert (ignored.finger[failed] > 0).all() and not ignored.encodable[failed].any()
    assert (negative.finger > 0).sum() == labels.true.sum()
    assert torch.isfinite(negative.parameters).all() and torch.isfinite(ignored.parameters).all()
    with pytest.raises(ValueError, match="dropped"):
        labels.targets(len(view), failed="dropped")


def test_only_the_points_that_backbones_choose_from_are_labelled(contact, toy_hand):
    view, grasps = ball_view(), ball_grasps(toy_hand)
    every, some = (label(view, grasps, contact, near(), LabelSettings(points=count)) for count in (None, 500))
    asked = farthest_points(view.points, 500).sort().values
    assert torch.equal(some.point.long(), asked)
    for name, value in some.tensors().items():
        assert torch.equal(value, every.tensors()[name][asked]), name
    targets = some.targets(len(view))
    unknown = torch.ones(len(view), dtype=torch.bool)
    unknown[asked] = False
    assert not targets.encodable[unknown].any() and (targets.finger[unknown] > 0).all(), "left out of every loss"
    assert targets.encodable[asked].all()


def test_order_of_grasps_does_not_matter(contact, toy_hand):
    view, grasps = ball_view(), ball_grasps(toy_hand)
    labels = label(view, grasps, contact, near(), ALL)
    shuffled = torch.randperm(len(grasps), generator=torch.Generator().manual_seed(1))
    again = label(view, grasps[shuffled], contact, near(), ALL)
    torch.testing.assert_close(again.parameters, labels.parameters)
    told = labels.true
    assert (shuffled[again.grasp[told].long()] == labels.grasp[told]).all()


def test_nothing_near_gives_no_label(contact, toy_hand):
    view, grasps = ball_view(), ball_grasps(toy_hand)
    for none in (grasps[:0], grasps.replace(contacts=grasps.contacts + 1.0)):
        labels = label(view, none, contact, near(), ALL)
        assert len(labels) == len(view) and (labels.finger == 0).all()
        targets = labels.targets(len(view))
        assert (targets.finger == 0).all() and targets.encodable.all()
    empty = View(view.points[:0], view.normals[:0], view.instance[:0], view.world_T_camera)
    assert len(label(empty, grasps, contact, near(), ALL)) == 0


def test_truth_without_closing_is_a_threshold_on_both(toy_hand):
    grasps = ball_grasps(toy_hand, 3)
    moved = grasps.pose.clone()
    moved[1, 0, 3] += 0.02
    moved[2, :3, :3] = axis_angle(torch.tensor([0.0, 0, 1]), torch.tensor(0.3)) @ moved[2, :3, :3]
    good, quality = near()(grasps.replace(pose=moved), grasps)
    assert good.tolist() == [True, False, False]
    assert quality[0] == grasps.quality[0] and (quality[1:] == 0).all()
