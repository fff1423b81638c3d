"""The dataset end to end, small: made once, the same for any number of workers, found again, repaired."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, open_dict

from dexgrasp.commands.dataset import tool
from dexgrasp.dataset import pipeline
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.pipeline import ensure, summary, table
from dexgrasp.dataset.store import Store
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse

MADE = [stage for stage in pipeline.STAGES if stage != "verdicts"]
"""What is made where nothing is to be verified by physics."""
Composed = Callable[..., DictConfig]
Made = tuple[DictConfig, Dataset]


def make(config: DictConfig) -> Dataset:
    return ensure(config.dataset, config.hand, config.repr)


@pytest.fixture
def made(tiny: tuple[DictConfig, Dataset]) -> tuple[DictConfig, Dataset]:
    return tiny


@pytest.fixture
def copy(made: tuple[DictConfig, Dataset], tmp_path: Path) -> Iterator[tuple[DictConfig, Dataset]]:
    """A dataset whose files may be damaged."""
    config = made[0].copy()
    subprocess.run(["cp", "-r", str(made[0].dataset.root), str(tmp_path / "data")], check=True)
    with open_dict(config):
        config.dataset.root = str(tmp_path / "data")
    yield config, make(config)


def manifests(dataset: Dataset) -> dict[str, list[str]]:
    found = {}
    for stage, folder in dataset.folders.items():
        shards = json.loads((folder / "manifest.json").read_text())["shards"]
        found[stage] = [shards[i]["sha256"] for i in sorted(shards, key=int)]
    return found


def test_flow_is_consistent(made: tuple[DictConfig, Dataset]) -> None:
    dataset = made[1]
    assert len(dataset.objects) == 2 and dataset.scenes == 4 and len(dataset) == 4
    assert list(dataset.split("train")) == [0, 1, 2] and list(dataset.split("validation")) == [3]
    assert sum(len(dataset.view_grasps(i)) for i in range(4)) > 0
    for index in range(4):
        view, grasps, scene = dataset.view(index), dataset.view_grasps(index), dataset.scene(dataset.scene_of(index))
        assert len(view) == 2048 and view.instance.max() < len(scene)
        camera_T_object = inverse(view.world_T_camera.double()) @ scene.poses
        for row, name in enumerate(scene.objects):
            # Grasps of a view touch the object that the view shows there.
            own = grasps[grasps.object == row]
            field = dataset.field(dataset.objects.names.index(name))
            local = own.moved(inverse(camera_T_object[row]))
            if len(own):
                assert field.distance(local.contacts.reshape(-1, 3).double()).abs().max() < 5e-4
            points = view.points[view.instance == row].double()
            seen = points @ inverse(camera_T_object[row])[:3, :3].T + inverse(camera_T_object[row])[:3, 3]
            if len(seen):
                assert field.distance(seen).abs().median() < 0.002
        targets = dataset.labels(index).targets(len(view))
        assert len(targets) == 2048


def test_found_again_and_independent_of_workers(
    made: tuple[DictConfig, Dataset], tmp_path: Path, composed: Composed
) -> None:
    config, dataset = made
    before = {path: path.stat().st_mtime_ns for path in Path(config.dataset.root).rglob("*.tar")}
    assert make(config).folders == dataset.folders
    assert {path: path.stat().st_mtime_ns for path in Path(config.dataset.root).rglob("*.tar")} == before
    other = composed(tmp_path / "data", "dataset.workers=2")
    assert manifests(make(other)) == manifests(dataset)


def test_settings_pick_the_stores(made: tuple[DictConfig, Dataset]) -> None:
    config = made[0]
    plain, hand, told = (pipeline.plain(part) for part in (config.dataset, config.hand, config.repr))

    def hashes(**changes: object) -> list[str]:
        return [pipeline.digest(pipeline._content(s, plain | changes, hand, told)) for s in MADE]

    same = hashes()
    assert hashes(workers=7, root="elsewhere", validation=0.5, name="x") == same
    views = hashes(camera=plain["camera"] | {"fx": 600.0})
    assert [a == b for a, b in zip(same, views, strict=True)] == [True, True, True, False, True]
    assert hashes(seed=5)[1:4] != same[1:4]
    identity = pipeline._identity(hand, made[1].hand)
    assert hand["urdf"] not in str(identity), "the same hand in another place is the same"
    heavier = pipeline._content("labels", plain, hand, told | {"alpha": 9.0})
    assert heavier == pipeline._content("labels", plain, hand, told), "loss weights do not change labels"


def test_travels_by_folder(made: tuple[DictConfig, Dataset]) -> None:
    dataset = made[1]
    text = pickle.dumps(dataset)
    assert len(text) < 20_000
    again = pickle.loads(text)
    assert torch.equal(again.view(0).points, dataset.view(0).points)
    assert pickle.loads(text) is again, "copies in one process share their caches"


def test_lost_shard_is_made_again(copy: tuple[DictConfig, Dataset]) -> None:
    config, dataset = copy
    before = manifests(dataset)
    lost = sorted(dataset.folders["scenes"].glob("*.tar"))[1]
    lost.unlink()
    with pytest.raises(DexgraspError, match="shards in"):
        Store.open(dataset.folders["scenes"])
    assert manifests(make(config)) == before and lost.exists()


def test_damaged_shard_is_named(copy: tuple[DictConfig, Dataset], capsys: pytest.CaptureFixture[str]) -> None:
    config, dataset = copy
    root = Path(config.dataset.root)
    assert tool(["verify", str(root)]) == 0
    assert tool(["inspect", str(dataset.folders["views"])]) == 0
    printed = capsys.readouterr().out
    assert "views, 4 items" in printed and "points (2048, 3) float32" in printed
    shard = sorted(dataset.folders["views"].glob("*.tar"))[2]
    shard.write_bytes(shard.read_bytes()[:5000])
    for attempt in (lambda: make(config), lambda: tool(["verify", str(root)])):
        with pytest.raises(DexgraspError) as error:
            attempt()
        assert str(shard) in str(error.value) and "5000 bytes" in str(error.value)
    shard.unlink()
    make(config)
    assert tool(["verify", str(root)]) == 0
    with pytest.raises(DexgraspError, match=r"manifest\.json"):
        tool(["verify", str(root / "nothing")])


def test_summary(made: tuple[DictConfig, Dataset]) -> None:
    rows = summary(made[1])
    assert [row.stage for row in rows] == MADE
    assert [row.items for row in rows] == [2, 2, 4, 4, 4] and all(row.bytes > 0 for row in rows)
    assert str(made[1].folders["views"]) in table(rows)


def test_bad_settings_leave_no_trace(tmp_path: Path, composed: Composed) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    config = composed(tmp_path / "data")
    with open_dict(config):
        config.dataset.objects = {"kind": "folder", "path": str(empty)}
    with pytest.raises(DexgraspError):
        make(config)
    wrong = composed(tmp_path / "data", "+dataset.scenes.colour=red")
    with pytest.raises(DexgraspError, match="colour"):
        make(wrong)
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_interrupt_leaves_whole_shards_and_is_taken_up(
    made: tuple[DictConfig, Dataset], tmp_path: Path, composed: Composed, tiny_overrides: list[str]
) -> None:
    command = [sys.executable, "-m", "dexgrasp", "dataset", *tiny_overrides, f"dataset.root={tmp_path / 'data'}"]
    run = subprocess.Popen(
        [*command, "dataset.workers=2"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=tmp_path
    )
    started = time.monotonic()
    while not list(tmp_path.rglob("grasps-*/shard-*.tar")) and run.poll() is None and time.monotonic() - started < 600:
        time.sleep(0.05)
    os.kill(run.pid, signal.SIGINT)
    output = run.communicate(timeout=600)[0].decode()
    assert run.returncode == 130, output
    assert not list(tmp_path.rglob("*.tmp"))
    config = composed(tmp_path / "data", "dataset.workers=1")
    assert manifests(make(config)) == manifests(made[1])


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["threading", "dask", "ray"])
def test_every_backend_makes_the_same_dataset(backend: str, made: Made, tmp_path: Path, composed: Composed) -> None:
    if backend != "threading":
        pytest.importorskip(backend)
    config = composed(tmp_path / "data", f"dataset.backend={backend}", "dataset.workers=2")
    assert manifests(make(config)) == manifests(made[1])


@pytest.mark.slow
def test_killed_runs_are_taken_up(made: Made, tmp_path: Path, composed: Composed, tiny_overrides: list[str]) -> None:
    command = [sys.executable, "-m", "dexgrasp", "dataset", *tiny_overrides, f"dataset.root={tmp_path / 'data'}"]
    for moment in np.random.default_rng(0).uniform(0.0, 1.0, 2):
        before = len(list(tmp_path.rglob("*.tar")))
        run = subprocess.Popen([*command, "dataset.workers=2"], stderr=subprocess.DEVNULL, cwd=tmp_path)
        started = time.monotonic()
        while len(list(tmp_path.rglob("*.tar"))) == before and run.poll() is None and time.monotonic() - started < 600:
            time.sleep(0.02)
        time.sleep(moment)
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
    assert manifests(make(composed(tmp_path / "data", "dataset.workers=1"))) == manifests(made[1])
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.slow
def test_jobs_of_a_cluster_make_one_dataset(made: Made, tmp_path: Path, tiny_overrides: list[str]) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    command = [sys.executable, "-m", "dexgrasp", "dataset", "-m", "part=range(0,2)", "parts=2"]
    command += ["hydra/launcher=submitit_local", f"dataset.root={tmp_path / 'data'}", "dataset.workers=1"]
    done = subprocess.run([*command, *tiny_overrides], cwd=tmp_path, capture_output=True, text=True, timeout=800)
    assert done.returncode == 0, done.stdout + done.stderr
    assert manifests(Dataset.open(tmp_path / "data")) == manifests(made[1])
