"""Bad input, as the command line sees it: one clear message, exit status 2, and the disk as it was."""

import errno
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hydra.core.global_hydra import GlobalHydra

from dexgrasp import __main__ as cli
from dexgrasp import config, load_hand
from dexgrasp.checkpoint import FILE
from dexgrasp.dataset import samples as samples_module
from dexgrasp.dataset.samples import collect
from dexgrasp.errors import DexgraspError, room
from dexgrasp.evaluation import Policy
from dexgrasp.meshes import load_folder
from dexgrasp.model import GraspNet, save_model
from dexgrasp.plugins import load_backbone, load_representation
from dexgrasp.representation import Targets
from dexgrasp.settings import read
from dexgrasp.training.settings import TrainerSettings

SAME = ["repr=contact", "repr.hidden=[16]", "backbone=pointnet", "backbone.points=32"]
"""The network of `checkpoint`."""
FINGERS = ("finger_1_outer", "finger_2_outer", "finger_3_outer")


@pytest.fixture
def command(monkeypatch, tmp_path, capfd):
    """command(arguments) runs in an empty folder and gives exit status and error output; the folder must stay empty."""
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    config.register()
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)

    def run(*arguments):
        status = cli.main(list(arguments))
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err and "Error executing job" not in out + err, err
        assert not list(here.iterdir()), "something is left behind"
        return status, err

    yield run
    GlobalHydra.instance().clear()


def refused(answer, *parts):
    status, err = answer
    assert status == 2, err
    told = err[err.index("dexgrasp ") :]
    assert told.count("expected ") == 1 and "\n  found  " in told and "\n  to do  " in told
    for part in parts:
        assert re.search(part, told), told


def write_hand(folder: Path, name: str, link: str = FINGERS[2]) -> Path:
    """A copy of the BarrettHand in a plain folder."""
    source = Path(load_hand("barrett").urdf).parents[1]
    (folder / "hand").mkdir(parents=True)
    shutil.copytree(source / "meshes", folder / "meshes")
    urdf = folder / "hand" / f"{name}.urdf"
    shutil.copy(source / "urdf" / "bh280.urdf", urdf)
    lines = [f"  - {{name: finger_{i + 1}, link: {each}}}" for i, each in enumerate((*FINGERS[:2], link))]
    text = "\n".join([f"name: {name}", f"urdf: {name}.urdf", "palm: palm", "shared: [spread]", "fingers:", *lines])
    urdf.with_suffix(".yaml").write_text(text + "\n")
    return urdf


def missing_mesh(urdf):
    (urdf.parents[1] / "meshes" / "outer.stl").unlink()


def missing_mimic(urdf):
    urdf.write_text(urdf.read_text().replace('<mimic joint="finger_1"', '<mimic joint="finger_one"'))


def millimetres(urdf):
    path = urdf.parents[1] / "meshes" / "outer.stl"
    trimesh.load(path).apply_scale(1000).export(path)


def cut_off(urdf):
    urdf.write_text(urdf.read_text()[:3000])


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (missing_mesh, ["mesh file of link 'finger_1_outer'", r"outer\.stl", r"mine\.urdf"]),
        (missing_mimic, ["finger_1_outer.*to mimic", "'finger_one'", "<mimic>"]),
        (millimetres, ["in metres", "extents of", r"0\.001"]),
        (cut_off, ["XML", "cut off"]),
    ],
)
def test_a_broken_hand(command, tmp_path, damage, parts):
    damage(write_hand(tmp_path / "mine", "mine"))
    refused(command("train", "--config-dir", str(tmp_path / "mine"), "hand=mine", "experiment=smoke"), *parts)


def test_a_link_that_is_not_there(command, tmp_path):
    write_hand(tmp_path / "mine", "mine", link="finger_4_outer")
    refused(command("dataset", "--config-dir", str(tmp_path / "mine"), "hand=mine"), "a link of hand", "finger_4_outer")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["train", "trainer.stepz=3"], ["'trainer.stepz'", r"did you mean 'trainer\.steps'"]),
        (["train", "dataset.scenes.cuont=3"], ["cuont", r"did you mean 'dataset\.scenes\.count'"]),
        (["train", "repr=contakt"], ["contact, .*pose", "did you mean 'contact'", "plugins"]),
        (["train", "dataset=smok"], ["did you mean 'smoke'", "train --help"]),
        (["train", "+trainer.colour=3"], ["keys of trainer", "colour"]),
        (["train", "+dataset.synthesis.colour=3"], [r"keys of dataset\.synthesis", "colour"]),
        (["train", "trainer.steps=many"], [r"trainer\.steps to be a whole number", "'many'"]),
        (["train", "trainer.steps=-1"], [r"trainer\.steps of at least 0"]),
        (["train", "trainer.steps=0"], [r"trainer\.steps=0 with init_from", "init_from=None"]),
        (["train", "trainer.device=quantum"], [r"trainer\.device", "quantum"]),
        (["train", "selection.depth=deep"], [r"selection\.depth to be a number or null"]),
        (["train", "evaluation.dataset.scenes.count=many"], ["whole number"]),
        (["train", "protocol.motion.hold=long"], [r"motion\.hold"]),
        (["train", "init_from=nowhere"], ["checkpoint", "nowhere"]),
        (["train", "resume=nowhere"], [r"config\.yaml", "resume"]),
        (["eval"], ["model", "model="]),
        (["eval", "model=nowhere"], ["checkpoint", "nowhere"]),
        (["dataset", "objects@dataset.objects=folder"], [r"dataset\.objects\.path"]),
        (["dataset", "objects@dataset.objects=folder", "dataset.objects.path=../nowhere"], ["no folder"]),
        (["dataset", "verify", "nowhere"], [r"manifest\.json"]),
        (["report", "nowhere"], ["report"]),
        (["hand", "check", "nobody"], ["nobody"]),
    ],
)
def test_wrong_words(command, arguments, parts):
    refused(command(*arguments), *parts)


def test_object_folders(command, tmp_path):
    words = ["dataset", "objects@dataset.objects=folder", "dataset.objects.workers=1"]
    (tmp_path / "empty").mkdir()
    refused(command(*words, f"dataset.objects.path={tmp_path / 'empty'}"), "meshes", r"\.obj")
    (tmp_path / "large").mkdir()
    trimesh.creation.box([80.0, 50.0, 40.0]).export(tmp_path / "large" / "box.stl")
    refused(command(*words, f"dataset.objects.path={tmp_path / 'large'}"), "extent is 80 m", r"scale=0\.001")


def test_an_open_mesh_is_skipped_or_mended_and_the_others_go_on(tmp_path, caplog, monkeypatch):
    monkeypatch.setenv("DEXGRASP_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "set"
    folder.mkdir()
    trimesh.creation.box([0.08, 0.05, 0.04]).export(folder / "whole.stl")
    torn = trimesh.creation.box([0.08, 0.05, 0.04])
    torn.update_faces(np.arange(12) > 1)
    torn.export(folder / "torn.stl")
    objects, skipped = load_folder(str(folder))
    assert [item.name for item in objects] == ["whole"] and [name for name, _ in skipped] == ["torn"]
    assert "skipped torn: not watertight" in caplog.text
    objects, skipped = load_folder(str(folder), repair=True)
    assert [item.name for item in objects] == ["torn", "whole"] and not skipped
    assert re.search(r"mended torn: repaired: surface moved [\d.]+ mm", caplog.text)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    hand, backbone = load_hand("barrett"), load_backbone("pointnet", points=32)
    representation = load_representation("contact", hand, backbone.channels, hidden=[16])
    parts = {
        "hand": {"name": "barrett", "urdf": str(hand.urdf), "shared": ["spread"], "palm": "palm",
            "least_fingers": 3, "fingers": [
            {"name": f"finger_{i + 1}", "link": link} for i, link in enumerate(FINGERS)]},
        "repr": {"name": "contact", "hidden": [16]},
        "backbone": {"name": "pointnet", "points": 32},
    }  # fmt: skip
    save_model(folder / FILE, GraspNet(backbone, representation, 64, parts))
    return folder


@pytest.mark.parametrize(
    ("points", "parts"),
    [
        (np.full((500, 3), np.nan), ["NaN", "500"]),
        (np.ones((20, 3)), ["at least 32 points", "20"]),
        (np.ones((500, 3)) * 700, ["metres", "millimetres", r"scale=0\.001"]),
        (np.ones((500, 4)), [r"\(P, 3\)"]),
    ],
)
def test_clouds(command, checkpoint, tmp_path, points, parts):
    np.save(tmp_path / "cloud.npy", points)
    refused(command("predict", f"model={checkpoint}", f"input={tmp_path / 'cloud.npy'}"), *parts)


def test_checkpoints(command, checkpoint, tmp_path):
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes((checkpoint / FILE).read_bytes()[:20000])
    for words in (["predict", f"model={cut}", "input=x.npy"], ["eval", f"model={cut}"], ["train", f"init_from={cut}"]):
        refused(command(*words), "whole safetensors file", "truncated")
    urdf = write_hand(tmp_path / "mine", "mine")
    urdf.write_text(urdf.read_text().replace('multiplier="0.3333333333333333"', 'multiplier="0.5"'))
    words = ["train", "--config-dir", str(tmp_path / "mine"), "hand=mine", f"init_from={checkpoint}"]
    refused(command(*words), "checkpoint of the hand 'mine'", "trained for 'barrett'", "fingertips differ")
    for other, told in (
        ("repr=pose", "repr=contact"),
        ("backbone=pointnet2", "backbone=pointnet"),
        ("repr.hidden=[8]", r"repr\.hidden=\[16\]"),
    ):
        same = [word for word in SAME if word.split("=")[0].split(".")[0] != other.split("=")[0].split(".")[0]]
        refused(command("train", *same, other, f"init_from={checkpoint}"), f"a network with {told}")


def test_resume_takes_the_kept_config_alone(command, tmp_path):
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "config.yaml").write_text("seed: 1\n")
    refused(command("train", f"resume={kept}", "trainer.steps=9"), "`resume` alone", r"trainer\.steps=9")
    assert (kept / "config.yaml").read_text() == "seed: 1\n"


def test_a_full_disk_is_told(command, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("dexgrasp.dataset.store.os.fsync", fail)
    status, err = command("dataset", "dataset=smoke", "dataset.root=../data")
    refused((status, err), "room for", "disk is full", "make room")


def test_a_full_disk_under_samples(monkeypatch, tmp_path):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def one(view):
        zeros = torch.zeros(64)
        return torch.rand(64, 6), Targets(zeros.long(), torch.zeros(64, 6), zeros, zeros.bool())

    backbone = load_backbone("pointnet", points=32)
    monkeypatch.setattr(samples_module.os, "posix_fallocate", fail)
    with pytest.raises(DexgraspError, match="disk is full"):
        collect([0, 1], one, backbone, tmp_path / "samples", "samples")
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".lock"]
    with pytest.raises(OSError, match="else"), room("x", tmp_path):
        raise OSError(errno.EIO, "something else")


def test_settings_say_what_is_wrong():
    assert read(Policy, {"attempts_per_object": 2}, "policy").attempts_per_object == 2
    for wrong in ({"angle": "wide"}, {"angle": True}, {"angle": float("nan")}, {"angel": 0.1}):
        with pytest.raises(DexgraspError, match="policy"):
            read(Policy, wrong, "policy")
    with pytest.raises(DexgraspError, match="no steps"):
        read(TrainerSettings, {"batch": 4, "shards": 2}, "trainer")


@pytest.mark.parametrize(
    ("word", "part"),
    [("top_k=none", "from 1"), ("top_k=0", "from 1"), ("target=cup", "from 0"), ("scale=mm", "metres per unit")],
)
def test_settings_of_predict_that_are_no_numbers(command, word, part):
    refused(command("predict", "input=x.npy", "model=run", word), word.partition("=")[0], part)
