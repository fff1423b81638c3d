"""The look ahead beside what closing finds."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.closing import CLOSED, close_fingers
from dexgrasp.collision import HandShape, as_arrays
from dexgrasp.dataset.proposals import Contact
from dexgrasp.dataset.surface import Surface
from dexgrasp.distance import DistanceField
from dexgrasp.hand_body import hand_body
from dexgrasp.headroom import headroom
from dexgrasp.objects import Object
from dexgrasp.preview import BURIED, SEEN, Preview


@pytest.fixture(scope="module")
def looked(hand):
    mesh = trimesh.creation.capsule(0.06, 0.03)
    surface = Surface.sample(
        Object("egg", "test", mesh, (mesh,)), DistanceField.build(mesh), 0.004, np.random.default_rng(0)
    )
    proposer = Contact(hand)
    pose, start = proposer.hands(surface, proposer.draw(surface, 3000, np.random.default_rng(1)))
    arrays = as_arrays(pose, start)
    found = close_fingers(hand_body(hand), surface.field.field, *arrays, False, True, 0.001)
    return surface.field, pose, start, Preview(hand).look(surface.field, *arrays, 0.001), found


def test_what_is_seen_mostly_closes_and_what_is_not_rarely_does(looked):
    _, _, _, (status, _, _), (closing, *_) = looked
    seen, closed = status == SEEN, closing == CLOSED
    assert 100 < seen.sum() < 2500
    assert closed[seen].mean() > 0.3
    assert closed[~seen].mean() < 0.1
    assert seen[closed].mean() > 0.85


def test_buried_hands_are_in_the_object(looked, hand):
    field, pose, start, (status, _, _), _ = looked
    buried = torch.from_numpy(status == BURIED)
    depth = HandShape(hand).object_distance(field, pose[buried], start[buried])
    assert len(depth) > 50
    assert depth.max() < -0.0005  # the grid is rough by less


def test_touches_lie_on_the_surface_where_closing_finds_them(looked, hand):
    field, pose, _, (status, full, touches), (closing, _, exact, *_) = looked
    both = (status == SEEN) & (closing == CLOSED)
    away = np.linalg.norm(touches[both][..., :3] - exact[both][..., :3], axis=-1)
    assert np.median(away) < 4e-3  # the tip is crowned, its circle a ball here
    assert np.quantile(np.abs(field.distance(touches[both][..., :3].reshape(-1, 3))), 0.95) < 5e-4
    joints = torch.from_numpy(full[both][:, hand_body(hand).leaders])
    tips = (pose[torch.from_numpy(both)][:, None] @ hand.fingertips(joints))[..., :3, 3]
    gap = field.distance(tips.reshape(-1, 3)) - hand.fingers[0].tip_radius
    assert gap.abs().max() < 1.5e-3


def test_headroom_is_the_height_over_each_table(hand):
    generator = torch.Generator().manual_seed(0)
    rotations = torch.linalg.qr(torch.randn(60, 3, 3, generator=generator, dtype=torch.float64)).Q
    rotations *= torch.linalg.det(rotations)[:, None, None]
    pose = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    pose[:, :3, :3] = rotations
    pose[:, :3, 3] = 0.1 * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    low, high = hand.limits.T
    joints = low + (high - low) * torch.rand(60, len(low), generator=generator, dtype=torch.float64)
    resting = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    resting[:, :3, :3], resting[:, 2, 3] = rotations[:5], 0.12
    shape = HandShape(hand)
    for least in (0.0, 0.05):
        found = headroom(shape, resting[:, 2], pose, joints, least)
        expected = torch.stack([shape.table_distance(rest @ pose, joints) >= least for rest in resting], dim=1)
        assert found.equal(expected)
        assert 0.05 < found.double().mean() < 0.95
