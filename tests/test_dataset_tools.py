"""What one can do with a made dataset: open, look into, verify, merge and export it; its cost is foretold."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, open_dict

from dexgrasp.commands.dataset import tool
from dexgrasp.dataset import estimation
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.estimation import estimate
from dexgrasp.dataset.merging import merge
from dexgrasp.dataset.pipeline import ensure
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.store import Store
from dexgrasp.dataset.verification import rechecked
from dexgrasp.errors import DexgraspError
from dexgrasp.origins import origins

READER = """
import sys
for name in sys.argv[2].split(","):
    sys.modules[name] = None
import dexgrasp
dataset = dexgrasp.open_dataset(sys.argv[1])
view, grasps = dataset.view(1), dataset.view_grasps(1)
assert len(view) == 2048 and len(grasps) == dataset.store("scenes")[1].facts["grasps"]
assert dataset.scene(1).objects[0] in dataset.objects.names and len(dataset.grasps(0)) > 0
assert dataset.objects[0].licence == "Apache-2.0" and len(dataset.objects[0].mesh.faces) > 10
"""
ABSENT = "mujoco,embreex,fcl,coal,coacd,manifold3d,pinocchio,yourdfpy,hydra,omegaconf,numba,ray,dask,joblib,matplotlib"

Made = tuple[DictConfig, Dataset]


@pytest.fixture
def other(tiny: Made, tmp_path: Path) -> Dataset:
    """The same objects, with grasps and scenes of another seed."""
    config, objects, root = tiny[0].copy(), tiny[1].folders["objects"], tmp_path / "other"
    shutil.copytree(objects, root / objects.name)
    with open_dict(config):
        config.dataset.seed, config.dataset.root = 1, str(root)
    return ensure(config.dataset, config.hand)


def test_opens_by_every_path(tiny: Made) -> None:
    dataset = tiny[1]
    root = Path(dataset.folders["views"]).parent
    for path in (root, dataset.folders["scenes"], dataset.card.with_suffix(".json")):
        assert Dataset.open(path).folders == dataset.folders
    with pytest.raises(DexgraspError, match="one dataset"):
        Dataset.open(root / "nothing")


def test_reads_without_simulator(tiny: Made) -> None:
    path = str(tiny[1].card.with_suffix(".json"))
    done = subprocess.run([sys.executable, "-c", READER, path, ABSENT], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def test_inspect_draws(tiny: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool(["inspect", str(tiny[1].card.with_suffix(".json")), "--picture", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    printed = capsys.readouterr().out
    assert "summary.candidates" in printed and "scenes, 4 items" in printed
    half = Dataset(tiny[1].config, tiny[1].hand_config, {k: tiny[1].folders[k] for k in ("objects", "grasps")})
    half.save(tmp_path / "dataset.json")
    assert tool(["inspect", str(tmp_path), "--picture", str(tmp_path / "b.png")]) == 0


def test_verify_tests_grasps_again(tiny: Made, tmp_path: Path) -> None:
    checks = {check.name: check for check in rechecked(tiny[1], 100, 4)}
    assert set(checks) == {"epsilon", "quality", "penetration", "closing", "scenes"}
    assert all(check.good for check in checks.values()), checks


@pytest.mark.parametrize(("stage", "bad"), [("grasps", {"epsilon", "closing"}), ("scenes", {"scenes"})])
def test_verify_finds_what_is_wrong(tiny: Made, tmp_path: Path, stage: str, bad: set[str]) -> None:
    """Contacts moved by a centimetre; objects of scenes lowered by three."""
    store = Store.create(tmp_path / stage, stage, {}, 0, 1)
    items = []
    for item in tiny[1].store(stage):
        tensors = dict(item.tensors)
        if stage == "grasps":
            tensors["contacts"] = tensors["contacts"] + torch.tensor([0.01, 0.0, 0.0])
        else:
            tensors["poses"] = tensors["poses"].clone()
            tensors["poses"][:, 2, 3] -= 0.03
        items.append(Item(item.key, tensors, item.facts))
    store.add(0, store.write_shard(0, items))
    store.finish()
    broken = Dataset(tiny[1].config, tiny[1].hand_config, {**tiny[1].folders, stage: tmp_path / stage})
    assert bad <= {check.name for check in rechecked(broken, 100, 4) if not check.good}


def test_verify_finds_a_wrong_form(tiny: Made, tmp_path: Path) -> None:
    store = Store.create(tmp_path / "views", "views", {}, 0, 1)
    items = [
        Item(item.key, {**item.tensors, "normals": item.tensors["normals"][1:]}) for item in tiny[1].store("views")
    ]
    store.add(0, store.write_shard(0, items))
    store.finish()
    with pytest.raises(DexgraspError, match="normals"):
        tool(["verify", str(tmp_path / "views")])


def test_card_names_licences(tiny: Made) -> None:
    text = tiny[1].card.read_text()
    assert "2 objects: Apache-2.0" in text and "annotations" in text and "| synthesis.friction | 0.5 |" in text
    for name in tiny[1].objects.names:
        assert f"| {name} | procedural seed=0 | Apache-2.0 |" in text


def test_origins_of_meshes(tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    listed = [{"file": "set/a.obj", "licence": "CC BY 4.0", "source_repo": "somewhere"}, {"file": "set/b.obj"}]
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": listed}))
    for root in (tmp_path, tmp_path / "set"):
        found = origins(root)
        assert found[(tmp_path / "set" / "a.obj").resolve()] == ("somewhere", "CC BY 4.0")
        assert found[(tmp_path / "set" / "b.obj").resolve()] == ("", "")
    (tmp_path / "manifest.json").write_text('{"objects": 3}')
    assert origins(tmp_path) == {}


def test_merged_datasets_hold_everything(tiny: Made, other: Dataset, tmp_path: Path) -> None:
    config, first = tiny
    plain = Dataset(first.config, first.hand_config, {k: v for k, v in first.folders.items() if k != "labels"})
    merged = Dataset.open(merge([plain, other], tmp_path / "both"))
    assert len(merged.objects) == 2, "equal objects are one"
    assert merged.scenes == 8 and list(merged.split("validation")) == [6, 7]
    assert [len(merged.grasps(i)) for i in range(2)] == [len(first.grasps(i)) + len(other.grasps(i)) for i in range(2)]
    sources = [(first, 0), (first, 1), (first, 2), (other, 0), (other, 1), (other, 2), (first, 3), (other, 3)]
    for number, (source, scene) in enumerate(sources):
        assert merged.scene(number).objects == source.scene(scene).objects
        for key, value in merged.scene_grasps(number).tensors().items():
            torch.testing.assert_close(value, source.scene_grasps(scene).tensors()[key], equal_nan=True, rtol=0, atol=0)
        assert torch.equal(merged.view(number).points, source.view(scene).points)
    assert all(check.good for check in rechecked(merged, 50, 8))
    with open_dict(config):
        again = config.copy()
    again.dataset.path = str(tmp_path / "both")
    labelled = ensure(again.dataset, again.hand, again.repr)
    assert len(labelled.store("labels")) == 8 and labelled.folders["views"] == merged.folders["views"]
    assert ensure(again.dataset, again.hand, again.repr).folders == labelled.folders


def test_unlike_datasets_do_not_merge(tiny: Made, tmp_path: Path) -> None:
    first = tiny[1]
    unlike = Dataset({**first.config, "camera": {"name": "other"}}, first.hand_config, first.folders)
    with pytest.raises(DexgraspError, match="camera"):
        merge([first, unlike], tmp_path / "both")
    with pytest.raises(DexgraspError, match="two"):
        merge([first], tmp_path / "both")


def test_webdataset_is_read_by_its_package(tiny: Made, tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset")
    dataset = tiny[1]
    assert (
        tool(["export", str(dataset.card.with_suffix(".json")), "--format", "webdataset", "--to", str(tmp_path)]) == 0
    )
    tars = sorted(map(str, tmp_path.glob("*.tar")))
    assert [Path(path).name for path in tars] == ["train-000000.tar", "validation-000000.tar"]
    samples = list(webdataset.WebDataset(tars, shardshuffle=False).decode())
    assert [sample["json"]["view"] for sample in samples] == [0, 1, 2, 3]
    for index, sample in enumerate(samples):
        assert np.array_equal(sample["points.npy"], dataset.view(index).points.numpy())
        grasps = dataset.view_grasps(index)
        for key, value in grasps.tensors().items():
            assert np.array_equal(sample["grasps.npz"][key], value.numpy(), equal_nan=value.is_floating_point())
        assert np.array_equal(sample["labels.npz"]["point"], dataset.labels(index).point.numpy())


def test_parquet_is_read_by_pandas(tiny: Made, tmp_path: Path) -> None:
    pandas, parquet = pytest.importorskip("pandas"), pytest.importorskip("pyarrow.parquet")
    dataset = tiny[1]
    assert tool(["export", str(dataset.card.with_suffix(".json")), "--format", "parquet", "--to", str(tmp_path)]) == 0
    table = pandas.read_parquet(tmp_path / "grasps.parquet")
    schema = parquet.read_schema(tmp_path / "grasps.parquet")
    assert b"m, rad" in schema.metadata.values() and b"frame" in schema.field("position").metadata[b"meaning"]
    assert len(table) == sum(len(dataset.grasps(i)) for i in range(2))
    own = table[table["object"] == dataset.objects.names[1]].reset_index()
    grasps = dataset.grasps(1)
    assert np.array_equal(np.stack(own["joints"]), grasps.joints.numpy())
    assert np.array_equal(np.stack(own["rotation"]).reshape(-1, 3, 3), grasps.pose[:, :3, :3].numpy())
    annotations = pandas.read_parquet(tmp_path / "annotations.parquet")
    assert len(annotations) == sum(len(dataset.scene_grasps(i)) for i in range(4))
    row = annotations.iloc[len(annotations) // 2]
    assert dataset.scene(int(row["scene"])).objects[int(row["place"])] == row["object"]


def test_estimate_foretells_every_stage(tiny: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tiny[0].copy()
    with open_dict(config):
        config.dataset.root = str(tmp_path / "new")
    rows = estimate(config.dataset, config.hand, config.repr, 5.0)
    assert [row.stage for row in rows] == ["start", "objects", "grasps", "scenes", "views", "labels"]
    assert [row.items for row in rows[1:]] == [2, 2, 4, 4, 4]
    for row in rows[1:]:
        shards = tiny[1].store(row.stage).shards
        true = sum(shard.bytes for shard in shards)
        # A tar is padded to 10 kB: one of the sample stands for one of each shard.
        assert row.bytes == pytest.approx(true, rel=0.25, abs=10_240 * len(shards)), row
        assert row.seconds > 0
    assert not (tmp_path / "new").exists(), "nothing is left"
    monkeypatch.setattr(estimation, "ITEMS", 1)
    fewer = estimate(config.dataset, config.hand, config.repr, 5.0)
    assert [row.items for row in fewer[1:]] == [2, 2, 4, 4, 4] and fewer[2].basis.startswith("1 of 2, ")
    assert all(row.basis == "made already" for row in estimate(tiny[0].dataset, tiny[0].hand, tiny[0].repr))
