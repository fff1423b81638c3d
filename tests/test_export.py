"""Exported graphs say what the network says; shipped weights load by name and carry a card."""

import copy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

import dexgrasp
from dexgrasp import checkpoint, shipping
from dexgrasp.errors import DexgraspError
from dexgrasp.export import trace
from dexgrasp.export_check import compare, level_views, runner
from dexgrasp.model import GraspNet, build_model, save_model
from dexgrasp.plugins import conf_folders, read
from dexgrasp.scorer import Scorer
from dexgrasp.selection import Selection
from dexgrasp.testing.views import seen_scenes

BACKBONE = {
    "name": "pointnet2",
    "points": [256, 64],
    "radii": [0.04, 0.12],
    "neighbours": [16, 16],
    "widths": [[16, 16], [32, 32]],
    "decoder": [[24]],
    "stem": 8,
}


@pytest.fixture(scope="module")
def model() -> GraspNet:
    torch.manual_seed(0)
    config = {kind: _yaml(kind, name) for kind, name in (("hand", "barrett"), ("repr", "contact"))}
    made = build_model(config | {"backbone": BACKBONE}, points=1024)
    made.scorer = Scorer(made.hand, made.backbone.channels, choices=2, most=100)
    return made.eval()


def _yaml(kind: str, name: str) -> dict:
    return read(next(p for _, folder in conf_folders() if (p := folder / kind / f"{name}.yaml").is_file()))


@pytest.mark.parametrize(("kind", "suffix"), [("heads", "pt2"), ("grasps", "pt2"), ("heads", "onnx")])
def test_a_graph_says_what_the_network_says(model, tmp_path, kind, suffix):
    if suffix == "onnx":
        pytest.importorskip("onnxscript")
        pytest.importorskip("onnxruntime")
    views = list(level_views(model, 3))
    graph, path = trace(model, views[0], kind), tmp_path / f"{kind}.{suffix}"
    graph.write(path)
    assert str(Path(dexgrasp.__file__).parent).encode() not in path.read_bytes(), "no path of this machine"
    # Of other sizes than the one it was traced with.
    views = [view[: 800 + 100 * number] for number, view in enumerate(views)]
    run = runner(path, graph.inputs)
    found = compare(model, kind, run, views, 1e-5)
    assert found.rows == 3 * (256 if kind == "heads" else 200)
    assert found.beyond <= (0 if kind == "heads" else 2), found
    worse = compare(model, kind, lambda given: {k: v + np.float32(1e-3) for k, v in run(given).items()}, views, 1e-5)
    assert worse.beyond == worse.rows


def test_a_scorer_that_follows_fingers_is_exported(model, tmp_path):
    wide = copy.deepcopy(model)
    wide.points = 2600
    wide.scorer = Scorer(
        wide.hand,
        wide.backbone.channels,
        choices=1,
        most=100,
        sweep=(-0.1, 0.1),
        along=(0.0, 1.0),
    ).eval()
    views = [view[: 2300 + 100 * number] for number, view in enumerate(level_views(wide, 2))]
    graph = trace(wide, views[0], "grasps")
    assert graph.about["coarse"] == wide.scorer.spread == 2048
    graph.write(tmp_path / "grasps.pt2")
    found = compare(wide, "grasps", runner(tmp_path / "grasps.pt2", graph.inputs), views, 1e-5)
    assert found.rows == 200 and found.beyond <= 2, found
    with pytest.raises(DexgraspError, match="2049 points"):
        trace(wide, views[0][:2000], "grasps")


def test_in_double_precision_no_choice_falls_otherwise(model, tmp_path):
    double = copy.deepcopy(model).double()
    views = [view[:900].double() for view in level_views(model, 2)]
    graph = trace(double, views[0], "grasps")
    graph.write(tmp_path / "grasps.pt2")
    found = compare(double, "grasps", runner(tmp_path / "grasps.pt2", graph.inputs), views, 1e-9)
    assert graph.about["dtype"] == "float64" and found.rows == 400 and found.beyond == 0, found


def test_weights_load_by_name_and_carry_a_card(model, tmp_path, monkeypatch):
    save_model(tmp_path / "run" / "model.safetensors", model, {"seed": 3, "steps": 7})
    (tmp_path / "run" / "results.json").write_text('{"scorer": {"area": 0.75}}')
    (tmp_path / "run" / ".hydra").mkdir()
    (tmp_path / "run" / ".hydra" / "overrides.yaml").write_text("- hand=barrett\n- meshes=/home/somebody/meshes\n")
    card = shipping.ship(tmp_path / "run" / "model.safetensors", "tiny", tmp_path / "weights", half=True, views=2)
    text = card.read_text()
    assert "seed 3, 7 steps" in text and "half precision" in text and "0.750" in text and "Not evaluated" in text
    assert "train hand=barrett meshes=DIR`" in text and "somebody" not in text
    full, half = (f.stat().st_size for f in (tmp_path / "run/model.safetensors", card.with_suffix(".safetensors")))
    assert half < 0.75 * full
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path / "weights")
    (tmp_path / "tiny").mkdir()
    monkeypatch.chdir(tmp_path)  # where a folder that is called so is not meant
    loaded = dexgrasp.load_model("tiny")
    assert {value.dtype for value in loaded.parameters()} == {torch.float32}
    for name, value in loaded.state_dict().items():
        torch.testing.assert_close(value, model.state_dict()[name], atol=1e-3, rtol=1e-3)
    with pytest.raises(DexgraspError, match="did you mean 'tiny'"):
        dexgrasp.load_model("tinny")


def test_a_card_tells_what_its_weights_began_with(model, tmp_path, monkeypatch):
    monkeypatch.setattr(shipping, "WEIGHTS", tmp_path / "weights")
    for name, start in (
        ("first", None),
        ("second", "first"),
        ("third", "elsewhere"),
        ("fourth", str(tmp_path / "first")),
    ):
        run = tmp_path / name
        save_model(run / "model.safetensors", model, {"seed": 3, "steps": 7 if start is None else 0})
        objects = {"kind": "procedural", "split": "train", "seed": 5 if start is None else 6}
        OmegaConf.save(OmegaConf.create({"init_from": start, "dataset": {"objects": objects}}), run / "config.yaml")
        shipping.ship(run / "model.safetensors", name, tmp_path / "weights", views=2)
    cards = ((tmp_path / "weights" / f"{name}.md").read_text() for name in ("first", "second", "third", "fourth"))
    first, second, third, fourth = cards
    assert "began" not in first and "seed 6" not in first
    assert all(word in second for word in ("0 steps", "7 steps", "seed 5), ", "seed 6), ", "`first` as shipped before"))
    assert "another training" in third and "seed 5" not in third
    assert all(word in fourth for word in ("another training:", "0 steps", "7 steps", "seed 5), ", "seed 6), "))
    assert str(tmp_path) not in fourth


def test_a_card_forgets_a_scorer_of_which_nothing_is_left(model, tmp_path, monkeypatch):
    monkeypatch.setattr(shipping, "WEIGHTS", tmp_path / "weights")
    for steps, seed, start in ((7, 1, None), (0, 2, "tiny"), (0, 3, "tiny")):
        run = tmp_path / str(seed)
        save_model(run / "model.safetensors", model, {"seed": seed, "steps": steps})
        told = {"init_from": start, "trainer": {"steps": steps}, "scorer": {"anew": True}}
        told |= {"dataset": {"objects": {"kind": "procedural", "split": "train", "seed": seed}}}
        OmegaConf.save(OmegaConf.create(told), run / "config.yaml")
        shipping.ship(run / "model.safetensors", "tiny", tmp_path / "weights", views=2)
    card = (tmp_path / "weights" / "tiny.md").read_text()
    assert "seed 3, 0 steps" in card and "seed 1, 7 steps" in card and "seed 2, 0 steps" not in card
    assert card.count("What it began with, the network of `tiny` as shipped before:") == 2


def test_what_is_not_shipped(model, tmp_path, monkeypatch):
    path = tmp_path / "run" / "model.safetensors"
    save_model(path, model)
    with pytest.raises(DexgraspError, match="small letters"):
        shipping.ship(path, "../Barrett", tmp_path)
    monkeypatch.setattr(shipping, "MOVED", 1e-7)
    with pytest.raises(DexgraspError, match="half precision"):
        shipping.ship(path, "tiny", tmp_path / "weights", half=True, views=1)
    monkeypatch.setattr(shipping, "LIMIT", 1000)
    with pytest.raises(DexgraspError, match="of shipped weights"):
        shipping.ship(path, "tiny", tmp_path / "weights")
    assert not (tmp_path / "weights").exists()


@pytest.mark.slow
def test_the_example_needs_no_torch(model, tmp_path):
    for package in ("onnxscript", "onnxruntime"):
        pytest.importorskip(package)
    trace(model, next(level_views(model, 1)), "grasps").write(tmp_path / "grasps.onnx")
    points = next(seen_scenes(1, 1024))
    np.save(tmp_path / "cloud.npy", points)
    script = Path(__file__).resolve().parents[1] / "examples/onnx/predict.py"
    command = f"import runpy, sys; sys.modules['torch'] = None; runpy.run_path({str(script)!r}, run_name='__main__')"
    words = [sys.executable, "-c", command, "grasps.onnx", "cloud.npy", "--top", "3"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    rows = [[float(word) for word in line.split()] for line in done.stdout.splitlines()[1:]]
    expected = model.predict(points, top_k=3, selection=Selection(depth=None, table=None, distance=0))
    np.testing.assert_allclose([row[0] for row in rows], expected.quality, atol=0.02)
