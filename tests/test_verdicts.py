"""Grasps verified by physics: what is stored is what physics says, and scenes are made of what lifts."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import DictConfig

from dexgrasp.collision import HandShape
from dexgrasp.commands.dataset import tool
from dexgrasp.dataset.clutter import Approach
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.pipeline import ensure, plain, plan
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.verdicts import VerifySettings, agreement, at_rest, metrics, summary, verify
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.objects import Object
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.statistics import roc_area, roc_curve
from dexgrasp.wrench_model import WrenchModel

Composed = Callable[..., DictConfig]


@pytest.fixture(scope="module")
def plate() -> Object:
    """Rests on either face, hardly ever on an edge."""
    mesh = trimesh.creation.box((0.12, 0.06, 0.03))
    return Object("plate", "test", mesh, (mesh,))


def from_above(turns: np.ndarray, height: float = 0.18) -> Grasps:
    """Hands above (z > 0) or below the middle of an object, turned about the vertical."""
    pose = torch.eye(4, dtype=torch.float64).repeat(len(turns), 1, 1)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0] if height > 0 else [1.0, 1.0, 1.0], dtype=torch.float64))
    for row, turn in enumerate(turns):
        pose[row, :3, :3] = torch.from_numpy(trimesh.transformations.rotation_matrix(turn, [0, 0, 1])[:3, :3]) @ down
    pose[:, 2, 3] = height
    joints = torch.tensor([[0.0, 0.9, 0.9, 0.9]], dtype=torch.float64).repeat(len(turns), 1)
    return Grasps.build(pose, joints, 3)


def test_the_stored_verdict_is_what_physics_says_again(hand, plate) -> None:
    grasps = Grasps.cat([from_above(np.linspace(0, 3, 5)), from_above(np.linspace(0, 3, 3), -0.18)])
    chosen, shape = VerifySettings(per_object=None), HandShape(hand)
    found = verify(hand, shape, plate, grasps, chosen, Approach(), np.random.default_rng(0))
    assert sorted(found.grasp.tolist()) == list(range(8)), "one side or the other is up"
    assert {round(float(pose[2, 2])) for pose in found.poses} >= {-1, 1}
    assert (found.reason == int(Reason.SUCCESS)).any()
    again = verify(hand, shape, plate, grasps, chosen, Approach(), np.random.default_rng(0))
    for name, value in found.tensors().items():
        assert torch.equal(value, again.tensors()[name]), name
    few = verify(hand, shape, plate, grasps, VerifySettings(per_object=3), Approach(), np.random.default_rng(0))
    assert torch.equal(few.grasp, found.grasp[:3]) and torch.equal(few.reason, found.reason[:3])
    simulator = MujocoSimulator(chosen.rules)
    for row in range(3):
        pose, grasp = found.poses[found.resting[row]], grasps[int(found.grasp[row])]
        assert (grasp.moved(pose).pose[0, 2, 3]) > 0, "the hand is above the table"
        outcome = simulator.execute([plate], pose[None], hand, grasp.moved(pose), chosen.rules)
        assert int(outcome.reason[0]) == int(found.reason[row])


def test_poses_at_rest_are_settled_and_likely(plate) -> None:
    poses, likely = at_rest(plate, MujocoSimulator("lift-bulk-v1"))
    assert 0.9 < float(likely.sum()) <= 1.0 + 1e-9 and len(poses) == len(likely)
    for pose in poses:
        lowest = (plate.mesh.vertices @ pose[:3, :3].numpy().T + pose[:3, 3].numpy())[:, 2].min()
        assert abs(lowest) < 1e-3


def test_metrics_of_a_symmetric_grasp(hand, plate) -> None:
    contacts = torch.tensor([[[0.0, 0.03, 0.0], [0.01, -0.03, 0.0], [-0.01, -0.03, 0.0]]])
    normals = torch.tensor([[[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, -1.0, 0.0]]])
    grasps = from_above(np.zeros(1)).replace(contacts=contacts.double(), normals=normals.double())
    told = metrics(grasps, WrenchModel(tuple(plate.com), plate.radius))
    assert float(told["centred"][0]) == pytest.approx(-0.01, abs=1e-9)
    assert 0.0 < float(told["epsilon"][0]) <= float(told["epsilon_linf"][0])
    assert float(told["volume"][0]) > 0 and 0.01 < float(told["spread"][0]) < 0.04


def test_agreement_is_the_area_under_the_roc() -> None:
    def item(scores: list[float], reasons: list[int]) -> Item:
        return Item("x", {"metric_a": torch.tensor(scores), "reason": torch.tensor(reasons, dtype=torch.int8)})

    found, lifted = agreement([item([0.9, 0.8, 0.2], [0, 0, 7]), item([10.0, 20.0], [5, 0]), item([5.0], [0])])
    assert lifted.tolist() == [True, True, False, False, True, True]
    assert found["a"].within == 1.0, "in each object the better ones lift"
    assert found["a"].pooled == pytest.approx(5 / 8)
    false, true = found["a"].curve
    assert (false[0], true[0], false[-1], true[-1]) == (0, 0, 1, 1)
    assert np.trapezoid(true, false) == pytest.approx(5 / 8)
    nothing, _ = agreement([item([1.0], [0])])
    assert nothing["a"].pooled is None and nothing["a"].within is None
    assert "100.0%" in summary([item([1.0], [0])], "p")[0] and summary([], "p") == ["nothing was tested"]


def test_curve_and_area_agree_on_ties() -> None:
    generator = torch.Generator().manual_seed(0)
    scores, truth = torch.randint(0, 6, (200,), generator=generator), torch.rand(200, generator=generator) < 0.4
    false, true = roc_curve(scores.float(), truth)
    assert np.trapezoid(true, false) == pytest.approx(roc_area(scores.float(), truth), abs=1e-12)


@pytest.mark.parametrize("wrong", [{"keep": "good"}, {"per_object": 0}, {"protocol": "lift-v9"}])
def test_wrong_settings_are_told(wrong: dict) -> None:
    with pytest.raises(DexgraspError):
        VerifySettings(**wrong)


FEW = ["dataset.synthesis.target=60", "dataset.scenes.count=3", "dataset.views.per_scene=0", "dataset.workers=1"]
VERIFIED = ["dataset.verify={protocol: lift-bulk-v1, per_object: 12, keep: lifted}", "dataset.scenes.lift_tests=4"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, composed: Composed) -> Dataset:
    config = composed(tmp_path_factory.mktemp("data"), *FEW, *VERIFIED)
    return ensure(config.dataset, config.hand)


def test_scenes_are_made_of_what_lifts(made: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    protocol = load_protocol("lift-bulk-v1")
    for number, item in enumerate(made.store("verdicts")):
        reasons = made.reasons(number)
        assert item.facts["protocol"] == str(protocol) and len(item.facts["protocol_hash"]) == 12
        assert item.facts["tested"] == int((reasons >= 0).sum()) <= 12
        assert item.facts["lifted"] == int((reasons == 0).sum()) == len(made.usable(number))
    carried = 0
    for index, item in enumerate(made.store("scenes")):
        for row, number in enumerate(made.scene_objects(index).tolist()):
            grasps = item.tensors["grasp"][item.tensors["grasp_object"] == row].long()
            assert (made.reasons(number)[grasps] == 0).all()
            carried += len(grasps)
        lift = item.facts["lift"]
        assert lift["protocol"] == str(protocol) and lift["tested"] == min(4, item.facts["grasps"])
        assert item.tensors["lift_row"].unique().numel() == lift["tested"] == len(item.tensors["lift_reason"])
    assert carried > 0
    assert tool(["inspect", str(made.folders["verdicts"])]) == 0
    printed = capsys.readouterr().out
    assert f"lifted by {protocol}" in printed


def test_only_what_follows_from_verdicts_depends_on_them(tmp_path: Path, composed: Composed) -> None:
    def names(*overrides: str) -> dict[str, str]:
        config = composed(tmp_path, *FEW, *overrides)
        return {stage: folder.name for stage, _, folder in plan(plain(config.dataset), plain(config.hand), None)}

    without, verified = names(), names(VERIFIED[0])
    assert "verdicts" not in without and list(verified) == ["objects", "grasps", "verdicts", "scenes", "views"]
    assert without["grasps"] == verified["grasps"] and without["scenes"] != verified["scenes"]
    kept = names(VERIFIED[0].replace("lifted", "tested"))
    assert kept["verdicts"] == verified["verdicts"] and kept["scenes"] != verified["scenes"]
    assert names(VERIFIED[0].replace("bulk-", ""))["verdicts"] != verified["verdicts"]


@pytest.mark.slow
def test_any_number_of_workers_gives_the_same_bytes(made: Dataset, tmp_path: Path, composed: Composed) -> None:
    config = composed(tmp_path, *FEW, *VERIFIED, "dataset.workers=2")
    again = ensure(config.dataset, config.hand)
    for stage in ("verdicts", "scenes"):
        sums = [
            [
                shard["sha256"]
                for shard in json.loads((data.folders[stage] / "manifest.json").read_text())["shards"].values()
            ]
            for data in (made, again)
        ]
        assert sums[0] == sums[1], stage
