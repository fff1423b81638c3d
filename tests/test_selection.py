"""Selection: what collides is not offered, what is offered differs, and the best come first."""

from dataclasses import replace

import pytest
import torch

from dexgrasp.execution import pregrasp
from dexgrasp.geometry import axis_angle, inverse, rotate, rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.selection import Selection, free, on_table, select

ALL = Selection(depth=None, table=None, distance=0.0)
FAR = torch.tensor([[0.0, 0.0, 5.0]])


def above(hand, heights: list[float], quality: list[float] | None = None, bend: float = 0.8) -> Grasps:
    """Grasps from straight above, the palm's face `heights` over z = 0 (z up), fingers bent by `bend`."""
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).repeat(len(heights), 1, 1)
    pose[:, 2, 3] = torch.tensor(heights) + float(hand.base_T_palm[2, 3])
    joints = torch.tensor([0.5, bend, bend, bend]).repeat(len(heights), 1)
    return Grasps.build(pose, joints, 3, quality=torch.tensor(quality or [0.5] * len(heights)))


def test_free_of_points(hand, shape):
    grasps = above(hand, [0.2])
    selection = Selection(table=None)
    palm = grasps.pose[0, :3, 3] - torch.tensor([0.0, 0.0, 0.06])  # inside the palm
    behind = grasps.pose[0, :3, 3] + torch.tensor([0.0, 0.0, 0.03])  # only met on the way
    tips = grasps.pose @ hand.fingertips(grasps.joints)[0]
    opened = pregrasp(hand, grasps, 0.0)[1]
    cases = {"nothing": (FAR, True), "palm": (palm[None], False), "way": (behind[None], False)}
    cases["where fingers close"] = (tips[:, :3, 3], True)
    cases["where fingers open"] = ((grasps.pose @ hand.fingertips(opened)[0])[:, :3, 3], False)
    for name, (points, expected) in cases.items():
        assert bool(free(hand, shape, grasps, points, None, selection)) == expected, name
    at_rest = replace(selection, retreat=0.0)
    assert bool(free(hand, shape, grasps, behind[None], None, at_rest))


def test_free_of_the_table(hand, shape):
    table = torch.eye(4).double()
    lowest = float(shape.table_distance(above(hand, [0.0]).pose, above(hand, [0.0]).joints))
    opened = pregrasp(hand, above(hand, [0.0]), 0.0)[1]
    lowest = min(lowest, float(shape.table_distance(above(hand, [0.0]).pose, opened)))
    grasps = above(hand, [-lowest + 0.003, -lowest - 0.0005, -lowest - 0.002])
    assert free(hand, shape, grasps, FAR, table, Selection()).tolist() == [True, True, False]
    assert free(hand, shape, grasps, FAR, None, Selection()).all()


def test_hands_that_reach_into_the_table_are_raised(hand, shape):
    table = torch.eye(4).double()
    table[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.3, -0.2], [-0.3, 0, 0.5], [0.2, -0.5, 0]]).double())
    table[:3, 3] = torch.tensor([0.1, -0.2, 0.7])
    level, postures = above(hand, [0.0]), []
    for joints in (level.joints, pregrasp(hand, level, 0.0)[1]):
        postures.append(float(shape.table_distance(level.pose, joints)))
    offsets = [-0.025, -0.015, -0.001, 0.003, 0.006]
    grasps = above(hand, [offset - min(postures) for offset in offsets]).moved(inverse(table))
    selection = Selection(upright=0.0, raised=0.02)
    done = on_table(hand, shape, grasps, table, selection)
    wanted = [0.0, 0.0155, 0.0015, 0.0, 0.0]
    moved = (done.pose - grasps.pose)[:, :3, 3].double()
    assert (moved @ table[2, :3]).tolist() == pytest.approx(wanted, abs=1e-5)
    assert moved.norm(dim=1).tolist() == pytest.approx([abs(value) for value in wanted], abs=1e-5)
    assert torch.equal(done.pose[:, :3, :3], grasps.pose[:, :3, :3]) and torch.equal(done.joints, grasps.joints)
    never = on_table(hand, shape, grasps, table, replace(selection, raised=0.0))
    assert torch.equal(never.pose, grasps.pose)
    # What reached into the table is offered from above it, and nobody's grasps are changed.
    before, cloud = grasps.pose.clone(), torch.cat([FAR, torch.tensor([[0.0, 0, -1]])], dim=1)
    offered = select(hand, grasps[1:2], cloud, 1, replace(selection, depth=None), table)
    assert torch.allclose(offered.pose, done.pose[1:2]) and torch.equal(grasps.pose, before)
    assert len(select(hand, grasps[:1], cloud, 1, replace(selection, depth=None), table)) == 0


def test_hands_that_come_down_steeply_come_straight_down(hand, shape):
    table = torch.eye(4).double()
    table[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.3, -0.2], [-0.3, 0, 0.5], [0.2, -0.5, 0]]).double())
    grasps = above(hand, [0.3, 0.3, 0.3, 0.3])
    tilts = torch.tensor([0.0, 0.2, 0.45, 0.6])
    axes = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [0.3, 0.9, 0], [-1, 1, 0], [0, 1, 0]]), dim=1)
    grasps.pose[:, :3, :3] = axis_angle(axes, tilts) @ grasps.pose[:, :3, :3]
    grasps = grasps.moved(inverse(table))
    done = on_table(hand, shape, grasps, table, Selection(upright=0.5))
    approach = rotate(done.pose.double(), hand.base_T_palm[:3, 2].double().expand(4, 3))
    angle = torch.acos((-(approach @ table[2, :3])).clamp(-1, 1))
    assert angle.tolist() == pytest.approx([0.0, 0.0, 0.0, 0.6], abs=1e-3)
    # No more than it takes, and about the fingertips' middle.
    assert rotation_angle(done.pose[:, :3, :3], grasps.pose[:, :3, :3]).tolist() == pytest.approx(
        [0.0, 0.2, 0.45, 0.0], abs=1e-3
    )
    middle = [(g.pose[:, None] @ hand.fingertips(g.joints).float())[..., :3, 3].mean(dim=1) for g in (done, grasps)]
    assert torch.allclose(*middle, atol=1e-5)
    assert torch.equal(done.pose[3], grasps.pose[3])


def test_select_sorts_limits_and_drops(hand):
    grasps = above(hand, [0.1, 0.2, 0.3, 0.4, 0.5], [0.2, 0.9, 0.4, 0.8, 0.6])
    grasps.pose[3, 0, 3] = float("nan")
    cloud = torch.cat([FAR, torch.tensor([[0.0, 0, -1]])], dim=1)
    assert select(hand, grasps, cloud, 9, ALL, None).quality.tolist() == pytest.approx([0.9, 0.6, 0.4, 0.2])
    assert select(hand, grasps, cloud, 2, ALL, None).quality.tolist() == pytest.approx([0.9, 0.6])
    assert select(hand, grasps, cloud, 9, replace(ALL, min_score=0.5), None).quality.tolist() == pytest.approx(
        [0.9, 0.6]
    )
    assert select(hand, grasps, cloud, 9, replace(ALL, candidates=3), None).quality.tolist() == pytest.approx(
        [0.9, 0.6, 0.4]
    )
    assert len(select(hand, grasps[:0], cloud, 9, ALL, None)) == 0


def test_select_drops_the_alike(hand):
    grasps = above(hand, [0.2, 0.205, 0.3, 0.2], [0.9, 0.8, 0.7, 0.6])
    half = torch.tensor(1.0)
    grasps.pose[3, :2, :2] = (
        torch.tensor([[half.cos(), -half.sin()], [half.sin(), half.cos()]]) @ grasps.pose[3, :2, :2]
    )
    cloud = torch.cat([FAR, torch.tensor([[0.0, 0, -1]])], dim=1)
    kept = select(hand, grasps, cloud, 9, Selection(depth=None, table=None), None)
    assert kept.quality.tolist() == pytest.approx([0.9, 0.7, 0.6])  # the second is 5 mm from the first, not turned


def test_select_checks_lazily_what_free_checks_eagerly(hand, shape):
    generator = torch.Generator().manual_seed(0)
    heights = (torch.rand(200, generator=generator) * 0.3).tolist()
    grasps = above(hand, heights, torch.rand(200, generator=generator).tolist())
    points = (torch.rand(500, 3, generator=generator) - 0.5) * torch.tensor([0.2, 0.2, 0.0])
    cloud = torch.cat([points, torch.tensor([0.0, 0, 1]).expand(500, 3)], dim=1)
    selection = Selection(distance=0.0, table=None)
    passed = grasps[free(hand, shape, grasps, points, None, selection)]
    best = passed[torch.argsort(passed.quality, descending=True)]
    assert 0 < len(passed) < 200
    assert torch.equal(select(hand, grasps, cloud, 30, selection, None).pose, best[:30].pose)
    assert torch.equal(select(hand, grasps, cloud, 500, selection, None).pose, best.pose)
