"""From an empty folder to a trained, evaluated network with one command, as a user runs it; and what it refuses."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file

import dexgrasp
from dexgrasp.dataset.store import Store

pytestmark = pytest.mark.timeout(1800)

FEW = [
    "trainer.steps=20",
    "trainer.save_every=5",
    "trainer.processes=1",
    "evaluation.dataset.objects.count=2",
    "evaluation.dataset.synthesis.target=50",
    "evaluation.dataset.synthesis.rounds=1",
    "evaluation.dataset.scenes.count=1",
    "evaluation.workers=1",
]


@pytest.fixture(scope="session")
def tiny_job(tiny_overrides: list[str]) -> list[str]:
    """Overrides of a whole job that is done in a minute."""
    return ["experiment=smoke", *tiny_overrides, *FEW]


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, "-m", "dexgrasp", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def run(folder: Path, *arguments: str) -> tuple[int, str, str]:
    process = start(folder, *arguments)
    out, err = process.communicate(timeout=1500)
    return process.returncode, out, err


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, tiny_job: list[str]) -> Path:
    """The run's folder."""
    home = tmp_path_factory.mktemp("home")
    status, out, err = run(home, "train", *tiny_job)
    assert status == 0, out + err
    folder = Path(out.splitlines()[-1])
    assert folder.parent == home / "runs" / "train"
    return folder


def test_everything_from_nothing(made: Path) -> None:
    results = json.loads((made / "results.json").read_text())
    assert results["schema"] == "dexgrasp.training/1" and results["training"]["steps"] == 20
    summary = results["evaluation"]["summary"]
    assert summary["scenes"] == 1 and summary["attempts"] > 0 and sum(summary["reasons"].values()) > 0
    page = (made / "evaluation" / "report.html").read_text()
    assert "lift-v1" in page and page.count("data:image/png") == page.count("<img ")
    steps = {int(row["step"]) for row in csv.DictReader((made / "metrics.csv").open())}
    assert max(steps) == 20 and list(made.glob("tensorboard/events*"))


def test_the_model_loads_and_predicts(made: Path, tmp_path: Path) -> None:
    stores = [Store.open(folder) for folder in made.parents[2].glob("data/views-*")]
    view = next(store for store in stores if len(store))[0].tensors
    grasps = dexgrasp.load_model(made).predict(view["points"], view["normals"], top_k=5)
    assert grasps.pose.isfinite().all() and (grasps.quality.diff() <= 0).all()
    np.save(tmp_path / "view.npy", view["points"].numpy())
    status, out, err = run(tmp_path, "predict", f"model={made}", "input=view.npy", "top_k=5", "selection.depth=null")
    assert status == 0, out + err
    folder = Path(out.splitlines()[-1])
    told = json.loads((folder / "results.json").read_text())
    with np.load(folder / "grasps.npz") as arrays:
        assert len(arrays["pose"]) == len(told["grasps"]) <= 5
    assert told["hand"] == "barrett" and told["joint_names"] == ["spread", "finger_1", "finger_2", "finger_3"]


def test_a_killed_training_goes_on_to_the_same_weights(made: Path, tiny_job: list[str]) -> None:
    home, folder = made.parents[2], made.parent / "killed"
    process = start(home, "train", *tiny_job, "evaluate=false", f"hydra.run.dir={folder}")
    until = time.monotonic() + 1200
    while not (folder / "training.safetensors").exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    assert process.poll() is None, process.communicate()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (folder / "model.safetensors").exists()
    words = (folder / ".hydra" / "overrides.yaml").read_text()
    status, _, err = run(home, "train", f"resume={folder}")
    assert status == 0, err
    assert (folder / ".hydra" / "overrides.yaml").read_text() == words, "what the run was told, not what resumed it"
    assert (folder / "model.safetensors").read_bytes() == (made / "model.safetensors").read_bytes()
    assert (folder / "metrics.csv").read_text() == (made / "metrics.csv").read_text()
    shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.parametrize("data", [[], ["dataset.seed=1"]], ids=["same data", "other data"])
def test_fine_tuning_starts_from_the_weights(made: Path, tiny_job: list[str], data: list[str]) -> None:
    home, folder = made.parents[2], made.parent / f"tuned{len(data)}"
    still = ["trainer.steps=1", "trainer.learning_rate=0.0", "evaluate=false"]
    status, out, err = run(home, "train", *tiny_job, *still, *data, f"init_from={made}", f"hydra.run.dir={folder}")
    assert status == 0, out + err
    before, after = load_file(made / "model.safetensors"), load_file(folder / "model.safetensors")
    measured = ("running_mean", "running_var", "num_batches_tracked")
    learnt = {key for key in before if key.startswith(("backbone.", "representation.")) and not key.endswith(measured)}
    assert len(learnt) > 20 and learnt <= after.keys()
    assert all(torch.equal(before[key], after[key]) for key in learnt)
    assert OmegaConf.load(folder / "config.yaml").init_from == str(made)


@pytest.mark.slow
def test_without_a_step_the_scorer_alone_is_taught(made: Path, tiny_job: list[str]) -> None:
    home, folder = made.parents[2], made.parent / "taught"
    words = [*tiny_job, "trainer.steps=0", "evaluate=false", f"hydra.run.dir={folder}"]
    status, _, err = run(home, "train", *words)
    assert status == 2 and "init_from" in err and "Traceback" not in err
    status, out, err = run(home, "train", *words, "dataset.seed=1", f"init_from={made}")
    assert status == 0, out + err
    assert "labels" not in out and "graspable" not in out
    before, after = load_file(made / "model.safetensors"), load_file(folder / "model.safetensors")
    network = {key for key in before if not key.startswith("scorer.")}
    assert len(network) > 20 and all(torch.equal(before[key], after[key]) for key in network)
    assert any(not torch.equal(before[key], after[key]) for key in before.keys() - network)


@pytest.mark.slow
def test_a_multirun_through_submitit_ends_with_one_table(made: Path, tiny_job: list[str]) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    words = ["train", "-m", "hydra/launcher=submitit_local", "repr=contact,pose", *tiny_job]
    process = start(made.parents[2], *words)
    out, err = process.communicate(timeout=1500)
    assert process.returncode == 0, out + err
    folder = Path(out.splitlines()[-1]).parent
    assert folder.name.endswith("_multirun") and out.count("# Comparison") == 1
    table = [line for line in (folder / "comparison.md").read_text().splitlines() if line.startswith("|")]
    assert table[0].startswith("| repr | SR % |")
    assert [line.split("|")[1].strip() for line in table[2:]] == ["contact", "pose"]
    rows = list(csv.DictReader((folder / "comparison.csv").open()))
    assert [row["folder"] for row in rows] == [str(folder / "0"), str(folder / "1")]
    assert (folder / "comparison.png").stat().st_size > 5000
