"""A grasp set under several protocols: verdicts that repeat, rules that bite, metrics that say what they say."""

import dataclasses
import json

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import __main__ as cli
from dexgrasp.collision import HandShape
from dexgrasp.commands.score import _scaled
from dexgrasp.dataset.verdicts import UNTESTED, VerifySettings
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.fingerprint import objects_hash
from dexgrasp.grasp_metrics import closed, diversity, grasp_metrics, self_penetration
from dexgrasp.grasp_scores import Judged, Scored, judge, metric_table, summary
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.interchange.binding import bind, unbound
from dexgrasp.interchange.formats import read_grasps, write_grasps
from dexgrasp.objects import Object
from dexgrasp.simulation.protocol import load_protocol

SUCCESS = int(Reason.SUCCESS)


def box(side: float = 0.05, name: str = "box") -> Object:
    mesh = trimesh.creation.box((side, side, 3 * side))
    return Object(name, "box", mesh, (mesh,), "test")


@pytest.fixture(scope="module")
def grasps(hand):
    """The hand about a box's waist, from the side, opposed (rows 0, 1) and far away (row 2)."""
    pose = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    # Palm's approach along -x of the object, fingers closing in the plane of y.
    pose[:, :3, :3] = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]], dtype=torch.float64)
    pose[:, 0, 3] = torch.tensor([0.12, 0.11, 0.5])
    joints = torch.tensor([0.0, 1.2, 1.2, 1.2], dtype=torch.float64).repeat(3, 1)
    return Grasps.build(pose, joints, len(hand.fingers))


def ruled(name: str, **changes):
    protocol = load_protocol(name)
    return dataclasses.replace(protocol, disturbance=dataclasses.replace(protocol.disturbance, **changes))


def test_floating_protocols_hold_and_repeat(hand, shape, grasps):
    for name in ("dexgraspbench", "isaac-dro"):
        first = judge(hand, shape, box(), grasps, load_protocol(name), 0)
        assert [int(r) == SUCCESS for r in first.reasons] == [True, True, False], name
        assert int(first.reasons[2]) == int(Reason.MISSED)
        assert torch.equal(judge(hand, shape, box(), grasps, load_protocol(name), 0).reasons, first.reasons)


def test_floating_protocols_bite(hand, shape, grasps):
    one = grasps[:1]

    def reason(protocol):
        return Reason(int(judge(hand, shape, box(), one, protocol, 0).reasons[0]))

    assert reason(ruled("dexgraspbench", force=2000.0)) is Reason.SLIPPED
    assert reason(ruled("isaac-dro", force=2000.0)) is Reason.SLIPPED
    assert reason(ruled("dexgraspbench", distance=1e-5)) is Reason.SLIPPED
    bench = load_protocol("dexgraspbench")
    deep = dataclasses.replace(bench, verdict=dataclasses.replace(bench.verdict, intrusion=0.0))
    into = one.replace(pose=one.pose - torch.tensor([[0, 0, 0, 0.06], [0] * 4, [0] * 4, [0] * 4]))
    assert Reason(int(judge(hand, shape, box(), into, deep, 0).reasons[0])) is Reason.COLLIDED


def test_shaking_and_carrying_are_harder_than_lifting(hand, shape, grasps):
    thing, upright = box(0.05), grasps[:1]
    names = ("lift-v1", "transport-v1", "shake-v1")
    told = {name: judge(hand, shape, thing, upright, load_protocol(name), 3).reasons for name in names}
    assert all(int(each[0]) in (SUCCESS, UNTESTED) for each in told.values())
    shake = load_protocol("shake-v1")
    hard = dataclasses.replace(shake, shake=dataclasses.replace(shake.shake, acceleration=200.0))
    if int(told["lift-v1"][0]) == SUCCESS:
        assert int(judge(hand, shape, thing, upright, hard, 3).reasons[0]) != SUCCESS


def test_floating_protocols_are_no_lift_tests():
    with pytest.raises(DexgraspError, match="table"):
        VerifySettings("dexgraspbench", None)


def test_metrics_of_postures(hand, shape, grasps):
    item, physics = box(0.08), load_protocol("lift-v1").physics
    surface = DistanceField.build(item.mesh)
    told = closed(hand, surface, grasps)
    found = grasp_metrics(hand, shape, item, surface, told, physics)
    far = {name: float(value[2]) for name, value in found.items()}
    assert (far["epsilon"], far["volume"], far["contact_count"], far["penetration"]) == (0, 0, 0, 0)
    assert far["contact_distance"] == pytest.approx(0.01) and np.isnan(far["spread"])
    assert float(found["epsilon"][0]) > 0 and float(found["epsilon_linf"][0]) >= float(found["epsilon"][0])
    ended = told.replace(joints=torch.tensor([[0.0, 2.4, 2.4, 2.4]] * 3, dtype=torch.float64))
    deep = grasp_metrics(hand, shape, item, surface, ended, physics)
    assert float(deep["penetration"][0]) > 0.005
    assert float(deep["penetration"][0]) == pytest.approx(
        -float(HandShape(hand).object_distance(surface, ended.pose, ended.joints)[0])
    )
    assert found["self_penetration"].tolist() == [0, 0, 0]


def test_self_penetration_is_where_the_hand_collides_with_itself(hand, shape):
    low, high = hand.limits.T
    draws = torch.rand(80, len(low), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    joints = low + (high - low) * draws
    many = Grasps.build(torch.eye(4, dtype=torch.float64).repeat(80, 1, 1), joints, len(hand.fingers))
    deep = self_penetration(hand, many, load_protocol("lift-v1").physics) > 5e-4
    collides = shape.self_collision(joints)
    assert deep.any() and not (deep & ~collides).any() and (deep == collides).double().mean() > 0.9


def test_diversity_grows_with_what_differs(hand, grasps):
    item = box()
    surface = DistanceField.build(item.mesh)
    same = closed(hand, surface, grasps[[0, 0, 0, 0]])
    turned = same.pose.clone()
    for number in range(4):
        angle = np.pi / 2 * number
        spin = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        turned[number, :3] = torch.from_numpy(spin) @ turned[number, :3]
    alike = diversity(hand, [(item, surface, same)], 0)
    spread = diversity(hand, [(item, surface, closed(hand, surface, same.replace(pose=turned)))], 0)
    assert alike["direction_entropy"] == alike["position_entropy"] == alike["joint_entropy"] == 0
    assert spread["direction_entropy"] == spread["position_entropy"] == pytest.approx(2.0)
    assert spread["surface_coverage"] > alike["surface_coverage"]


def scored(wins: list[list[bool]]) -> list[Scored]:
    rows = []
    for number, each in enumerate(wins):
        reasons = torch.tensor([SUCCESS if win else int(Reason.SLIPPED) for win in each])
        metrics = {"epsilon": torch.tensor(each).double(), "penetration": torch.tensor(each).double()}
        rows.append(Scored(box(name=f"box_{number}"), {"lift-v1": Judged(reasons, 1.0)}, metrics))
    return rows


def test_intervals_by_what_depends_on_what():
    rule = load_protocol("lift-v1")
    kinds = {
        "bootstrap": [[True, False], [True, True], [False, False]],
        "wilson": [[True], [False], [True]],
        "wilson over groups": [[True, True], [True]],
    }
    for kind, wins in kinds.items():
        entry = summary(scored(wins), rule, 0)["success_rate"]
        assert entry["interval_kind"] == kind and entry["low"] <= entry["value"] <= entry["high"]
        assert entry["low"] < entry["high"]
    assert summary(scored([[True] * 9]), rule, 0)["success_rate"]["interval_kind"] == "wilson"


def test_untested_grasps_are_no_attempts():
    rows = scored([[True, False]])
    rows[0].judged["lift-v1"].reasons[1] = UNTESTED
    entry = summary(rows, load_protocol("lift-v1"), 0)
    assert entry["success_rate"]["trials"] == 1 and entry["success_rate"]["value"] == 1 and entry["grasps"] == 2


def test_areas_are_signed_by_what_is_better():
    table = metric_table(scored([[True, False, True], [False, True]]), [load_protocol("lift-v1")])
    assert table["epsilon"]["areas"]["lift-v1"] == {"all": 1.0, "within": 1.0}
    assert table["penetration"]["areas"]["lift-v1"] == {"all": 0.0, "within": 0.0}


def test_same_objects_have_the_same_hash():
    assert objects_hash([box(), box(name="b")]) == objects_hash([box(name="b"), box()])
    assert objects_hash([box()]) != objects_hash([box(0.051)])


def test_meshes_at_the_scales_of_a_file(tmp_path):
    """DexGraspNet's meshes have no unit, and one mesh several sizes."""
    trimesh.creation.box((1.0, 0.5, 0.5)).export(tmp_path / "mug.stl")
    trimesh.creation.box((1.0, 1.0, 1.0)).export(tmp_path / "box.stl")
    options = {"kind": "folder", "path": str(tmp_path), "scale": None, "include": "*"}
    bodies = [("mug", 0.06), ("box", 0.05), ("mug", 0.12)]
    found = list(_scaled(options, bodies))
    assert [item.name for item in found] == ["mug x 0.06", "box", "mug x 0.12"]
    for item, (_, scale) in zip(found, bodies, strict=True):
        assert item.mesh.extents[0] == pytest.approx(scale) and item.mesh.is_watertight
        parts = np.concatenate([part.vertices for part in item.parts])
        assert np.ptp(parts, axis=0) == pytest.approx(item.mesh.extents, rel=0.02)
    with pytest.raises(DexgraspError):
        list(_scaled(options, [("mugg", 0.06)]))


def test_a_file_says_the_same_as_the_dataset_it_comes_from(hand, shape, grasps, tmp_path):
    """Through DexGraspBench's files, the verdicts stay."""
    one = grasps.replace(object=torch.zeros(3, dtype=torch.long))
    write_grasps(unbound(one, hand, ("box",) * 3), tmp_path / "bench", "dexgraspbench")
    back = bind(read_grasps(tmp_path / "bench"), hand).grasps
    rule = load_protocol("isaac-dro")
    first, second = (judge(hand, shape, box(), each, rule, 0).reasons for each in (one, back))
    assert torch.equal(first, second)


def test_command_without_meshes_or_with_the_wrong_hand(hand, grasps, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = write_grasps(unbound(grasps, hand, ("box",) * 3), tmp_path / "g.safetensors", "dexgrasp")
    assert cli.main(["eval", f"grasps={path}"]) == 2
    assert "objects=folder" in capsys.readouterr().err
    assert cli.main(["eval", f"grasps={path}", "hand=panda"]) == 2
    assert "joints of panda" in capsys.readouterr().err


def test_command_on_a_dataset(tiny, tmp_path, monkeypatch, capsys):
    _, dataset = tiny
    monkeypatch.chdir(tmp_path)
    path = dataset.card.with_suffix(".json")
    arguments = ["eval", f"grasps={path}", "protocol=[lift-bulk-v1,dexgraspbench]", "per_object=3", "workers=1"]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert "lift-bulk-v1 (version 4)" in out and "dexgraspbench (version 1)" in out
    results = json.loads(next(tmp_path.rglob("results.json")).read_text())
    assert results["schema"] == "dexgrasp.scores/1" and results["grasps"] == 6
    assert [row["success_rate"]["trials"] for row in results["protocols"]][1] == 6
    assert set(results["metrics"]) >= {"epsilon", "volume", "penetration", "self_penetration", "contact_distance"}
    for wrong in ("protocol=[]", "protocol=[lift-v9]", "protocol=[lift-v1,lift-v1]", "grasps=nothing"):
        assert cli.main([*arguments, wrong]) == 2
