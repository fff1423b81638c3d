"""Checkpoint files: whole or not at all, and one clear error for each way to be wrong."""

import json
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file

from dexgrasp import checkpoint
from dexgrasp.checkpoint import (
    check_hand,
    find_checkpoint,
    kinematics,
    load_start,
    load_state,
    read_tensors,
    write_tensors,
)
from dexgrasp.errors import DexgraspError


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep" / "model.safetensors"


def test_round_trip(path):
    tensors = {"a": torch.randn(3, 4).T, "b.c": torch.arange(5), "d": torch.tensor(True)}
    write_tensors(path, tensors, {"step": 7, "losses": {"x": 0.5}})
    found, notes = read_tensors(path)
    assert notes["step"] == 7 and notes["losses"] == {"x": 0.5}
    assert all(torch.equal(found[key], tensors[key]) for key in tensors) and found.keys() == tensors.keys()
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_failed_write_leaves_the_old_file(path, monkeypatch):
    write_tensors(path, {"a": torch.ones(3)}, {"step": 1})

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint.os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        write_tensors(path, {"a": torch.zeros(3)}, {"step": 2})
    assert read_tensors(path)[1]["step"] == 1
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_missing_truncated_and_foreign_files(path):
    with pytest.raises(DexgraspError, match="no file"):
        read_tensors(path)
    write_tensors(path, {"a": torch.randn(1000)}, {})
    whole = path.read_bytes()
    for content in (whole[:-100], whole[:20], b"", b"<html>not found</html>" * 20):
        path.write_bytes(content)
        with pytest.raises(DexgraspError, match="whole safetensors file"):
            read_tensors(path)
    save_file({"a": torch.ones(2)}, path)
    with pytest.raises(DexgraspError, match="no header of dexgrasp"):
        read_tensors(path)
    save_file({"a": torch.ones(2)}, path, metadata={"dexgrasp": json.dumps({"format": 99})})
    with pytest.raises(DexgraspError, match="format 99"):
        read_tensors(path)


def test_find(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path / "weights")
    write_tensors(tmp_path / "weights" / "barrett-contact.safetensors", {}, {})
    write_tensors(tmp_path / "run" / checkpoint.FILE, {}, {})
    assert find_checkpoint("barrett-contact").parent.name == "weights"
    assert find_checkpoint(tmp_path / "run") == find_checkpoint(str(tmp_path / "run" / checkpoint.FILE))
    with pytest.raises(DexgraspError, match="did you mean 'barrett-contact'"):
        find_checkpoint("baret-contact")
    with pytest.raises(DexgraspError, match=r"model\.safetensors in the folder"):
        find_checkpoint(tmp_path)


def test_load_state_is_strict(tmp_path):
    layer = torch.nn.Linear(2, 3)
    good = {key: value.clone() + 1 for key, value in layer.state_dict().items()}
    for bad in ({"weight": good["weight"]}, {**good, "extra": torch.ones(1)}, {**good, "bias": torch.ones(7)}):
        with pytest.raises(DexgraspError, match="1 of 2 tensors"):
            load_state(layer, bad, tmp_path)
    load_state(layer, good, tmp_path)
    assert torch.equal(layer.weight, good["weight"])


def test_another_hand_is_refused(tmp_path):
    from dexgrasp import load_hand

    hand = load_hand("barrett")
    trained = json.loads(json.dumps(kinematics(hand)))
    check_hand(hand, trained, tmp_path)
    limits = [[low, high + 0.01] for low, high in trained["limits"]]
    for changed, told in (
        ({"limits": limits}, "limits differ"),
        ({"joints": ["a", "b"], "name": "other"}, "'other'.*joints a, b"),
        ({"fingertips": (torch.tensor(trained["fingertips"]) + 0.001).tolist()}, "fingertips differ"),
        ({"fingertips": [[[0.0, 0.0, 0.0]]]}, "fingertips differ"),
    ):
        with pytest.raises(DexgraspError, match=told):
            check_hand(hand, {**trained, **changed}, tmp_path)
    renamed = SimpleNamespace(**{**vars(hand), "name": "copy"}, fingertips=hand.fingertips)
    check_hand(renamed, trained, tmp_path)  # a name alone makes no other hand


def test_a_training_starts_only_from_weights_of_its_own_network(tmp_path, caplog):
    from dexgrasp import load_hand

    config = {"repr": {"name": "contact", "bins": 7, "alpha": 1.0}, "backbone": {"name": "pointnet", "local": [8, 8]}}
    hand, path, layer = load_hand("barrett"), tmp_path / checkpoint.FILE, torch.nn.Linear(2, 3)
    notes = {"kind": "model", "hand": kinematics(hand), "config": config}
    write_tensors(path, {"weight": torch.ones(3, 2), "bias": torch.ones(3)}, notes)
    composed = OmegaConf.create({**config, "repr": {**config["repr"], "alpha": 2.0, "new": None, "frame": "upright"}})
    load_start(layer, hand, composed, path)  # weights of losses may differ, options of a later version may come
    assert layer.weight.min() == 1 and "trained with repr.alpha=1.0 no repr.frame;" in caplog.text
    for kind in ("repr", "backbone"):
        with pytest.raises(DexgraspError, match=f"of a network with {kind}={config[kind]['name']}\n"):
            load_start(layer, hand, {**config, kind: {"name": "other"}}, path)
    for kind, change, told in (
        ("repr", {"bins": 8}, r"repr\.bins=7"),
        ("backbone", {"local": [16, 16]}, r"backbone\.local=\[8,8\]"),
    ):
        with pytest.raises(DexgraspError, match=f"with {told}\n"):
            load_start(torch.nn.Linear(2, 4), hand, {**config, kind: {**config[kind], **change}}, path)
    write_tensors(path, {}, {"step": 3, "losses": {}})  # the state for resuming
    with pytest.raises(DexgraspError, match=r"(?s)weights of a finished training.*model\.safetensors"):
        load_start(layer, hand, config, path)
