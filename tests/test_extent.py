"""What a scorer is told of the thing at which a grasp is told."""

import numpy as np
import pytest
import torch

from dexgrasp.connected import connected
from dexgrasp.extent import GAP, NUMBERS, extents, extents_reference, things, things_reference
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps
from dexgrasp.segmentation import LOWEST


def box(low, high, step=0.008):
    """Return points all through a box, with normals that do not matter here."""
    axes = [torch.arange(a, b + step / 2, step) for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*axes)
    return torch.cat([points, torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)], dim=1)


def scene():
    """Return a table with a box of 4 x 6 x 8 cm and, 5 cm beside it, one of 4 x 4 x 2.4 cm."""
    table = box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.0), 0.02)
    return torch.cat([table, box((0.0, 0.0, 0.016), (0.04, 0.06, 0.08)), box((0.09, 0.0, 0.016), (0.13, 0.04, 0.024))])


def hands(count, hand, seed=0):
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    turned = axis_angle(axis, 3 * torch.rand(count, generator=generator))
    joints = hand.limits.float().mean(dim=1).expand(count, -1)
    return Grasps.build(pose(turned, 0.1 * torch.randn(count, 3, generator=generator)), joints, len(hand.fingers))


def at(*places):
    return torch.tensor([[*place, 0.0, 0.0, 1.0] for place in places])


def test_it_is_told_of_the_thing_at_which_it_is_told(hand):
    base = Grasps.build(torch.eye(4)[None], hand.limits.float().mean(dim=1)[None], len(hand.fingers))
    told = extents(base, at((0.041, 0.03, 0.05)), scene())[0]
    assert told.shape == (NUMBERS,)
    expected = torch.tensor([0.02, 0.028, 0.048, 0.0, 0.0, 0.016, 0.04, 0.056, 0.08, 0.08]) / 0.1
    torch.testing.assert_close(told[:10], expected, atol=1e-5, rtol=0)
    assert told[10] == pytest.approx(6 * 8 * 9 / 200)
    small = extents(base, at((0.1, 0.02, 0.03)), scene())[0]
    assert small[3] == pytest.approx(0.9) and small[9] == pytest.approx(0.24)
    assert not extents(base, at((-0.15, -0.15, 0.0)), scene()).any(), "the table is no thing"
    assert not extents(base, at((0.0, 0.0, 0.0)), scene()[:400]).any(), "nor where there is nothing else"


def test_it_is_said_in_the_hand_s_frame(hand):
    grasps, points = hands(20, hand), scene()
    places = at(*[(0.02, 0.03, 0.05)] * 20)
    told = extents(grasps, places, points)
    own = points[21 * 21 : 21 * 21 + 6 * 8 * 9, :3]
    for row in range(20):
        frame = grasps.pose[row].double()
        local = (own.double() - frame[:3, 3]) @ frame[:3, :3] / 0.1
        expected = torch.cat([local.mean(dim=0), local.amin(dim=0), local.amax(dim=0)])
        torch.testing.assert_close(told[row, :9].double(), expected, atol=1e-4, rtol=0)
    turn = pose(axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.7)), torch.tensor([0.3, -0.2, 0.0]))
    moved = [torch.cat([x[:, :3] @ turn[:3, :3].T + turn[:3, 3], x[:, 3:]], dim=1) for x in (places, points)]
    torch.testing.assert_close(extents(grasps.moved(turn), *moved), told, atol=1e-4, rtol=0)


def test_compiled_and_plain_say_the_same(hand):
    rng = np.random.default_rng(0)
    for case in range(10):
        points = torch.from_numpy(rng.uniform((-0.2, -0.2, -0.01), (0.2, 0.2, 0.1), (600 + 100 * case, 3))).float()
        points = torch.cat([points, torch.zeros(len(points), 3)], dim=1)
        grasps, places = hands(30, hand, case), points[torch.from_numpy(rng.integers(len(points), size=30))]
        quick = extents(grasps, places, points)
        torch.testing.assert_close(quick, extents_reference(grasps.pose, places, points), atol=1e-4, rtol=1e-4)
        double = extents(grasps.to(torch.float64), places, points)
        assert double.dtype == torch.float64
        torch.testing.assert_close(double.float(), quick, atol=1e-4, rtol=1e-4)


def test_things_are_what_hangs_together():
    rng = np.random.default_rng(1)
    for count in (1, 2, 300, 2048):
        points = rng.uniform((-0.2, -0.2, -0.01), (0.2, 0.2, 0.1), (count, 3)).astype(np.float32)
        found, above = things(points), points[:, 2] > LOWEST
        assert (found[~above] == -1).all()
        if above.any():
            expected = connected(points[above].astype(float), GAP)
            same = expected[:, None] == expected
            np.testing.assert_array_equal(found[above][:, None] == found[above], same)
            least = np.array([np.flatnonzero(above)[row].min() for row in same])
            np.testing.assert_array_equal(found[above], least)
        np.testing.assert_array_equal(things_reference(torch.from_numpy(points)).numpy(), found)


def test_plain_labels_come_along_a_snake_in_any_order():
    """The longest way that there is among 2,048 points, none of whose neighbours is next to it in order."""
    along = 0.015 * torch.arange(2048)
    snake = torch.stack([along, torch.zeros(2048), torch.full_like(along, 0.05)], dim=1)
    for seed in range(5):
        shuffled = snake[torch.randperm(2048, generator=torch.Generator().manual_seed(seed))]
        np.testing.assert_array_equal(things(shuffled.numpy()), 0)
        assert not things_reference(shuffled).any()
