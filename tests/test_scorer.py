"""The scorer: what it sees of a hand's surroundings, and how a network with one proposes."""

import dataclasses
import math

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dexgrasp import config as settings
from dexgrasp import selection
from dexgrasp.cloud import prepare
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import axis_angle, pose, rotate, transform
from dexgrasp.grasps import Grasps
from dexgrasp.model import GraspNet, build_model, load_model, save_model
from dexgrasp.scorer import Scorer, platt
from dexgrasp.selection import Selection
from dexgrasp.statistics import roc_area
from dexgrasp.surroundings import (
    COARSE,
    FINE,
    NEAREST,
    around_reference,
    coarse_points,
    surroundings,
    swept,
)
from dexgrasp.table import find_table
from dexgrasp.testing.samples import seen
from dexgrasp.training import proposals, scoring
from dexgrasp.training.scorer_settings import ScorerSettings, scorer_settings

OPEN = Selection(depth=None, table=None)


def network(points: int) -> GraspNet:
    settings.register()
    with initialize_config_dir(str(settings.conf_folder()), version_base="1.3"):
        config = compose("train", overrides=["backbone=pointnet", "backbone.points=256"])
    torch.manual_seed(0)
    return build_model(config, points=points).eval()


def some(hand, count=5):
    generator = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    turned = axis_angle(axis, 3 * torch.rand(count, generator=generator))
    lower, upper = hand.limits.float().unbind(-1)
    joints = lower + (upper - lower) * torch.rand(count, len(lower), generator=generator)
    return Grasps.build(pose(turned, 0.1 * torch.randn(count, 3, generator=generator)), joints, 3)


def cloud(count=1000):
    points = seen(count, 4)
    return torch.cat([points, torch.nn.functional.normalize(-points, dim=1)], dim=1)


def test_surroundings_are_the_nearest_points_in_the_palm_s_frame(hand):
    grasps, points = some(hand), coarse_points(cloud())
    assert points.shape == (COARSE, 6)
    around = surroundings(hand, grasps, points)
    assert around.shape == (5, NEAREST, 7)
    for row in range(5):
        palm = (grasps.pose[row] @ hand.base_T_palm.float()).double()
        tips = (grasps.pose[row] @ hand.fingertips(grasps.joints[row : row + 1])[0].float())[:, :3, 3].mean(0)
        nearest = (points[:, :3] - tips).norm(dim=1).argsort()[:NEAREST]
        local = (torch.linalg.inv(palm)[:3, :3] @ (points[nearest, :3].double() - palm[:3, 3]).T).T / 0.1
        expected = torch.cat([local, points[nearest, 2:3].double() / 0.1], dim=1)
        found = around[row][:, [0, 1, 2, 6]].double()
        matched = torch.cdist(expected, found).argmin(dim=1)
        assert len(matched.unique()) == NEAREST
        torch.testing.assert_close(found[matched], expected, atol=1e-4, rtol=0)
    told = around_reference(*middle_and_palm(hand, grasps), points, NEAREST)
    assert torch.cdist(told.double(), around.double()).amin(dim=2).max() < 1e-5


def middle_and_palm(hand, grasps):
    palm = grasps.pose @ hand.base_T_palm.float()
    return transform(grasps.pose, hand.fingertips(grasps.joints)[..., :3, 3].mean(dim=1).float()), palm


def test_a_fingertip_on_its_way_sees_the_point_nearest_to_it_there(hand):
    grasps, points = some(hand), coarse_points(cloud(3000), FINE)
    sweep = (-0.2, 0.0, 0.3)
    found = swept(hand, grasps, points, sweep)
    assert found.shape == (5, len(hand.fingers), 3, 7)
    tips = (grasps.pose[:, None] @ hand.fingertips(grasps.joints).float()).flatten(0, 1)  # at the posture told
    told = around_reference(tips[:, :3, 3], tips, points, 1, 0.03)
    torch.testing.assert_close(found[:, :, 1], told.reshape(5, -1, 7), atol=1e-5, rtol=1e-5)
    lower, upper = hand.limits.float().unbind(1)
    moves = torch.tensor([0.0 if name == "spread" else 1.0 for name in hand.joint_names])
    for k, share in enumerate(sweep):
        joints = torch.minimum(torch.maximum(grasps.joints + share * (upper - lower) * moves, lower), upper)
        tips = grasps.pose[:, None] @ hand.fingertips(joints)
        gaps = torch.cdist(tips[..., :3, 3], points[:, :3].expand(5, -1, -1))
        torch.testing.assert_close(found[:, :, k, :3].norm(dim=-1) * 0.03, gaps.amin(dim=2), atol=1e-5, rtol=0)
    inner = swept(hand, grasps, points, sweep, (0.0, 1.0))
    torch.testing.assert_close(inner[:, :, :3], found)
    outer = hand.fingers[0].outer_joint.float()  # as far from what is seen as the outer joint itself
    joints = torch.minimum(torch.maximum(grasps.joints - 0.2 * (upper - lower) * moves, lower), upper)
    link = grasps.pose @ hand.link_poses(joints)[hand.fingers[0].link]
    apart = torch.cdist(transform(link, outer.expand(5, 3)), points[:, :3]).amin(dim=1)
    torch.testing.assert_close(inner[:, 0, 3, :3].norm(dim=-1) * 0.03, apart, atol=1e-5, rtol=0)
    assert swept(hand, grasps, points, ()).shape == (5, len(hand.fingers), 0, 7)
    far = grasps.replace(pose=grasps.pose + torch.tensor([[0.0, 0.0, 0.0, 5.0]] * 3 + [[0.0] * 4]))
    assert swept(hand, far, points, sweep).isfinite().all()


def test_a_scene_turned_about_the_vertical_looks_the_same_to_the_hand(hand):
    grasps, points = some(hand), coarse_points(cloud())
    turn = pose(axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.7)), torch.tensor([0.3, -0.2, 0.0]))
    rotation = turn[:3, :3].T
    moved = torch.cat([points[:, :3] @ rotation + turn[:3, 3], points[:, 3:] @ rotation], dim=1)
    here, there = surroundings(hand, grasps, points), surroundings(hand, grasps.moved(turn), moved)
    assert torch.cdist(here.double(), there.double()).amin(dim=2).max() < 1e-4


def test_a_scorer_tells_by_what_its_fingers_meet(hand):
    """In pieces in evaluation as all at once in training's way; it tells otherwise where other points are."""
    torch.manual_seed(0)
    scorer = Scorer(hand, 8, sweep=(-0.1, 0.2), along=(0.0, 0.6)).eval()
    grasps, points = some(hand, 300), coarse_points(cloud(3000), FINE)
    given = torch.randn(300, 8), torch.randn(300, 6), grasps
    around, on_way = scorer.look(grasps, points)
    told = scorer(*given, around, on_way)
    with torch.no_grad():
        near = scorer.around(around.flatten(0, 1)).unflatten(0, (300, -1)).amax(dim=1)
        offset = (grasps.pose[:, :3, 3] - given[1][:, :3]) / 0.1
        own = [
            near,
            offset,
            grasps.pose[:, :3, :2].flatten(1),
            given[1][:, 3:],
            given[1][:, 2:3] / 0.1,
            grasps.joints,
            scorer.way(on_way.flatten(2)).flatten(1),
        ]
        expected = scorer.layers(torch.cat([given[0], *own], dim=1)).squeeze(1)
    torch.testing.assert_close(told, expected, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(scorer(*given, around, on_way.flip(0)), told)
    blind = Scorer(hand, 8)
    assert blind.spread == COARSE and scorer.spread == FINE and blind.look(grasps, points)[1].shape[2] == 0


def test_few_points_are_enough(hand):
    assert surroundings(hand, some(hand), coarse_points(cloud(40))).shape == (5, 40, 7)


def test_a_network_with_a_scorer_chooses_from_several_answers(tmp_path):
    model, points = network(1024), seen(1500)
    plain = model.predict(points, top_k=500, selection=OPEN)
    torch.manual_seed(5)
    model.scorer = Scorer(model.hand, model.backbone.channels, choices=3, most=100).eval()
    grasps = model.predict(points, top_k=500, selection=OPEN)
    assert (grasps.quality.diff() <= 0).all() and not torch.equal(grasps.pose[:5], plain.pose[:5])
    proposed = model.propose(cloud())
    assert len(proposed) == 300, "three answers at each of the hundred points that are most graspable"
    features, seeds, told = model.told(cloud(), choices=3, most=100)
    points_at, normals_at = cloud()[seeds].split(3, dim=1)
    with torch.no_grad():
        for choice, each in enumerate(told):  # all answers at once say what each says alone
            alone = model.representation.decode(points_at, normals_at, model.representation(features, choice=choice))
            torch.testing.assert_close(each.pose, alone.pose)
    first, second = proposed.pose[:100], proposed.pose[100:200]
    assert not torch.isclose(first, second).flatten(1).all(dim=1).any()
    save_model(tmp_path / "model.safetensors", model)
    again = load_model(tmp_path / "model.safetensors").predict(points, top_k=500, selection=OPEN)
    assert torch.equal(again.pose, grasps.pose) and torch.equal(again.quality, grasps.quality)


def test_grasps_are_set_up_as_the_scorer_was_taught(tmp_path):
    model, points = network(1024), seen(1500)
    open_selection = dataclasses.replace(OPEN, table=1.0)  # what reaches into the table stays
    model.scorer = Scorer(model.hand, model.backbone.channels, choices=1, most=400, upright=1.3, raised=0.02).eval()
    save_model(tmp_path / "model.safetensors", model)
    model = load_model(tmp_path / "model.safetensors")
    assert model.selecting() == dataclasses.replace(model.selection, upright=1.3, raised=0.02)
    asked = dataclasses.replace(open_selection, upright=0.0)
    assert model.selecting(asked) == dataclasses.replace(asked, raised=0.02), "what is told counts"
    table = find_table(prepare(points, None, model.points, 0), 0)

    def straight(grasps: Grasps) -> int:
        down = rotate(grasps.pose.double(), model.hand.base_T_palm[:3, 2].double().expand(len(grasps), 3))
        return int((-(down @ table[2, :3].double()) > 1 - 1e-6).sum())

    taught, off = (model.predict(points, top_k=400, selection=each) for each in (open_selection, asked))
    assert straight(taught) > 0 and straight(off) == 0
    model.scorer = None
    assert model.selecting() == dataclasses.replace(model.selection, upright=0.0, raised=0.0)


def test_it_learns_from_what_holds_and_leaves_the_network_as_it_is(tmp_path, monkeypatch, tiny):
    """Dataset and network are real and small; what meets the cloud counts too, or an untrained network has nothing."""
    monkeypatch.setattr(proposals, "free", lambda hand, shape, grasps, *_: torch.ones(len(grasps), dtype=torch.bool))
    dataset, model = tiny[1], network(2048)
    save_model(tmp_path / "model.safetensors", model)
    told = ScorerSettings(choices=2, most=200, per_view=60, epochs=2, batch=32)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    found = []
    for _ in range(2):
        summary = scoring.fit_scorer(model, tmp_path / "model.safetensors", dataset, told, 0, 1)
        found.append({key: value.clone() for key, value in model.state_dict().items()})
    assert summary.proposals > 20 and 0 <= summary.holding <= 1
    assert {key for key in found[0]} > set(before), "a scorer came in addition"
    assert all(torch.equal(found[0][key], found[1][key]) for key in found[0])
    assert all(torch.equal(found[0][key], value) for key, value in before.items()), "the network is as it was"


def test_it_tries_what_it_would_choose_itself(tmp_path, monkeypatch, tiny):
    """One grasp of each object in each view, the best of those told there, is executed and added to what is known."""
    for where in (proposals, selection):
        monkeypatch.setattr(where, "free", lambda hand, shape, grasps, *_: torch.ones(len(grasps), dtype=torch.bool))
    dataset, model = tiny[1], network(2048)
    save_model(path := tmp_path / "model.safetensors", model)
    told = ScorerSettings(choices=2, most=200, per_view=60, epochs=1, batch=32, chosen=1)
    once = scoring.fit_scorer(model, path, dataset, told, 0, 1)
    save_model(path, model)
    views = dataset.split("train")[:3]
    own = [proposals.propose(path, dataset, [view], told, 0, 1, "own", own=True) for view in views]
    for view, part in zip(views, own, strict=True):
        seen = dataset.view(view).instance
        assert 1 <= len(part) <= len(seen[seen >= 0].unique()) and not part.lifted.isnan().any()
        with torch.no_grad():
            rest = proposals.propose(path, dataset, [view], told, 0, 1, "some")
            best, others = (scoring._told_by(model.scorer, each).max() for each in (part, rest))
            assert best >= others - 1e-4
    model.scorer = None
    save_model(path, model)
    twice = scoring.fit_scorer(model, path, dataset, dataclasses.replace(told, rounds=2), 0, 1)
    assert twice.proposals > once.proposals and (twice.chosen is None) == (not dataset.split("validation"))


def test_verdicts_judge_what_was_not_tried(tmp_path, monkeypatch, tiny, capsys):
    """With few verdicts what a grasp holds decides; with enough, what a surrogate of physics has learnt of them."""
    monkeypatch.setattr(proposals, "free", lambda hand, shape, grasps, *_: torch.ones(len(grasps), dtype=torch.bool))
    dataset, model = tiny[1], network(2048)
    save_model(path := tmp_path / "model.safetensors", model)
    told = ScorerSettings(choices=2, most=200, per_view=60, epochs=1, batch=32, verdicts=20, surrogate=True)
    known = proposals.propose(path, dataset, dataset.split("train"), told, 0, 1, "some")
    assert known.facts.isfinite().all()
    same, none = scoring._foretold(known, told, 0)
    assert "of 200 for a surrogate" in capsys.readouterr().err
    assert none is None and torch.equal(same.worth, known.worth)
    monkeypatch.setattr(scoring, "FEWEST", 10)
    off, none = scoring._foretold(known, dataclasses.replace(told, surrogate=False), 0)
    assert none is None and torch.equal(off.worth, known.worth)
    taught, surrogate = scoring._foretold(known, told, 0)
    assert surrogate is not None and not torch.equal(taught.worth, known.worth)
    tried = ~known.lifted.isnan()
    before = (known.worth - known.lifted)[tried].square().mean()
    assert (taught.worth - known.lifted)[tried].square().mean() < before
    summary = scoring.fit_scorer(model, path, dataset, told, 0, 1)
    assert 0 < summary.promise < 1 and summary.surrogate["trials"] > 0


def test_it_begins_with_the_one_that_a_network_had(tmp_path, monkeypatch, tiny):
    monkeypatch.setattr(proposals, "free", lambda hand, shape, grasps, *_: torch.ones(len(grasps), dtype=torch.bool))
    dataset, model = tiny[1], network(2048)
    save_model(path := tmp_path / "model.safetensors", model)
    told = ScorerSettings(choices=2, most=200, per_view=60, epochs=1, batch=32)
    scoring.fit_scorer(model, path, dataset, told, 0, 1)
    had, model.scorer = model.scorer, None
    still = dataclasses.replace(told, learning_rate=1e-9)
    scoring.fit_scorer(model, path, dataset, still, 1, 1, had)
    weights = model.scorer.state_dict()
    for name, value in had.state_dict().items():  # statistics of the norms are measured anew
        if "running" not in name and "tracked" not in name:
            torch.testing.assert_close(weights[name], value, atol=1e-5, rtol=1e-5)
    scoring.fit_scorer(model, path, dataset, dataclasses.replace(still, hidden=(32,)), 1, 1, had)
    assert model.scorer.options["hidden"] == [32], "of another size it begins with nothing"
    scoring.fit_scorer(model, path, dataset, dataclasses.replace(still, anew=True), 1, 1, had)
    weights = model.scorer.state_dict()
    assert any(
        (weights[name] - value).abs().max() > 0.01 for name, value in had.state_dict().items() if "weight" in name
    )


def test_a_scorer_is_taught_as_the_one_that_it_begins_with_was_where_nothing_else_is_told(hand):
    start = Scorer(hand, 8, choices=1, most=640, hidden=[64], upright=0.5, raised=0.02)
    config = {"upright": None, "raised": None, "choices": None, "most": 80, "hidden": None}
    for told, upright in ((None, 0.5), (0.0, 0.0), (0.3, 0.3)):
        read = scorer_settings({**config, "upright": told}, start)
        assert (read.upright, read.raised, read.choices, read.most, read.hidden) == (upright, 0.02, 1, 80, (64,))
    alone = scorer_settings(OmegaConf.create({**config, "raised": 0.01}), None)
    assert alone == ScorerSettings(raised=0.01, most=80)
    with pytest.raises(DexgraspError, match=r"scorer\.choices"):
        scorer_settings({**config, "choices": "many"}, start)


def test_an_experiment_leaves_out_the_scorer_where_it_is_told_to():
    settings.register()
    with initialize_config_dir(str(settings.conf_folder()), version_base="1.3"):
        for overrides, taught in ((["experiment=shipped", "scorer=none", "meshes=."], False), ([], True)):
            assert compose("train", overrides=overrides).scorer.taught is taught


def test_settings_are_checked():
    for change in (
        {"choices": 0},
        {"rounds": 0},
        {"upright": -0.1},
        {"views": 0},
        {"sweep": (0.0, 1.2)},
        {"along": (-3.0,)},
        {"along": ()},
        {"clear": (0.1, 0.2)},
        {"blocked": (0.1, 0.2, 0.3, 1.5)},
    ):
        with pytest.raises(DexgraspError, match=f"scorer.{next(iter(change))}"):
            ScorerSettings(**change)
    with pytest.raises(DexgraspError, match=r"scorer\.verdicts"):
        ScorerSettings(surrogate=True)


def test_roc_area():
    truth = torch.tensor([False, False, True, True])
    assert roc_area(torch.tensor([0.1, 0.2, 0.3, 0.4]), truth) == 1
    assert roc_area(torch.tensor([0.4, 0.3, 0.2, 0.1]), truth) == 0
    assert roc_area(torch.tensor([0.5, 0.5, 0.5, 0.5]), truth) == 0.5
    assert roc_area(torch.tensor([0.1, 0.3, 0.2, 0.4]), truth) == 0.75
    assert roc_area(torch.ones(4), torch.ones(4, dtype=torch.bool)) is None
    assert not math.isnan(roc_area(torch.rand(100), torch.rand(100) > 0.5))


def test_calibration_makes_probabilities_come_true_and_keeps_the_order(hand):
    torch.manual_seed(0)
    logits = 2 * torch.randn(4000)
    came = torch.bernoulli((0.5 * logits - 1).sigmoid())
    slope, shift = platt(logits, came)
    assert slope == pytest.approx(0.5, abs=0.06) and shift == pytest.approx(-1, abs=0.1)
    for all_alike in (torch.ones(50), torch.zeros(50)):
        slope, shift = platt(logits[:50], all_alike)
        assert slope > 0 and math.isfinite(shift)
    scorer, grasps = Scorer(hand, 8).eval(), some(hand, 64)
    at = torch.randn(64, 6)
    given = torch.randn(64, 8), at, grasps, *scorer.look(grasps, coarse_points(cloud()))
    before = scorer(*given).detach()
    came = torch.bernoulli((before - before.mean()).sigmoid())
    slope, shift = platt(before, came)
    scorer.calibrate(before, came)
    torch.testing.assert_close(scorer(*given), slope * before + shift, atol=1e-4, rtol=1e-4)
