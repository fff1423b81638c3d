"""Shards are whole or absent, and say so when they are damaged."""

import errno
import multiprocessing
import os
import tarfile
import time
from pathlib import Path

import pytest
import safetensors.torch
import torch

from dexgrasp.dataset import shard as module
from dexgrasp.dataset.claims import claim, lock
from dexgrasp.dataset.shard import Item, write_shard
from dexgrasp.dataset.store import Store, digest, recorded
from dexgrasp.dataset.temporary import sweep, temporary
from dexgrasp.errors import DexgraspError

CONFIG = {"a": 1, "b": {"c": [1.5, "x"]}}


def items(start: int, count: int = 3) -> list[Item]:
    return [
        Item(f"{i:06d}", {"x": torch.full((i + 1, 3), float(i)), "n": torch.tensor([i])}, {"name": f"thing.{i}"})
        for i in range(start, start + count)
    ]


def filled(folder: Path, shards: int = 3) -> Store:
    store = Store.create(folder, "test", CONFIG, 0, shards)
    for i in store.missing:
        store.add(i, store.write_shard(i, items(3 * i)))
    store.finish()
    return store


def test_reads_what_was_written(tmp_path: Path) -> None:
    filled(tmp_path)
    store = Store.open(tmp_path)
    assert len(store) == 9 and store.keys == [f"{i:06d}" for i in range(9)]
    for i in (8, 0, 4):
        item = store[i]
        assert item.key == f"{i:06d}" and item.facts == {"name": f"thing.{i}"}
        assert torch.equal(item.tensors["x"], torch.full((i + 1, 3), float(i)))
    assert store["000005"].tensors["n"].item() == 5
    assert [facts["name"] for facts in store.facts()] == [f"thing.{i}" for i in range(9)]
    assert store.verify() == 3


def test_shards_are_plain_tars(tmp_path: Path) -> None:
    filled(tmp_path)
    with tarfile.open(tmp_path / "shard-00001.tar") as tar:
        assert tar.getnames()[:2] == ["000003.safetensors", "000003.json"]
        file = tar.extractfile("000004.safetensors")
        assert file is not None
        assert torch.equal(safetensors.torch.load(file.read())["n"], torch.tensor([4]))


def test_same_items_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    assert write_shard(tmp_path / "a", 0, items(0)) == write_shard(tmp_path / "b", 0, items(0))
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"a": 1, "b": 3})


def test_resume_makes_only_what_is_missing(tmp_path: Path) -> None:
    store = Store.create(tmp_path, "test", CONFIG, 0, 3)
    store.add(1, store.write_shard(1, items(3)))
    (tmp_path / ".shard-00002.tar.1.tmp").write_bytes(b"left by a killed run")
    with pytest.raises(DexgraspError, match="3 shards"):
        Store.open(tmp_path)
    again = Store.create(tmp_path, "test", CONFIG, 0, 3)
    assert again.missing == [0, 2] and not list(tmp_path.glob(".*.tmp"))
    filled(tmp_path)
    (tmp_path / "shard-00000.tar").unlink()
    assert Store.create(tmp_path, "test", CONFIG, 0, 3).missing == [0]
    filled(tmp_path)
    assert Store.open(tmp_path).verify() == 3


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    filled(tmp_path)
    with pytest.raises(DexgraspError, match="hash"):
        Store.create(tmp_path, "test", CONFIG | {"a": 2}, 0, 3)


@pytest.mark.parametrize("damage", ["truncate", "flip"])
def test_damage_is_named(tmp_path: Path, damage: str) -> None:
    store = filled(tmp_path)
    path = tmp_path / "shard-00001.tar"
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[700] ^= 1
    path.write_bytes(content if damage == "flip" else content[:1000])
    if damage == "truncate":
        reads: list = [lambda: Store.open(tmp_path), lambda: store[4], store.verify]
    else:
        opened = Store.open(tmp_path)
        reads = [lambda: opened[4], opened.verify]
        assert opened[0].tensors["n"].item() == 0
    expected = store.manifest["shards"]["1"]["sha256"]
    for read in reads:
        with pytest.raises(DexgraspError) as error:
            read()
        assert str(path) in str(error.value) and expected in str(error.value) and "delete" in error.value.remedy


def test_broken_manifest_and_schema(tmp_path: Path) -> None:
    with pytest.raises(DexgraspError, match=r"manifest\.json"):
        Store.open(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(DexgraspError, match="readable manifest"):
        Store.open(tmp_path)
    (tmp_path / "manifest.json").write_text('{"schema": 99}')
    with pytest.raises(DexgraspError, match="schema 99"):
        Store.open(tmp_path)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    store = filled(tmp_path, shards=2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(module.os, "fsync", fail)
    with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else DexgraspError):
        store.write_shard(1, items(30))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def _hold(folder: Path, log: Path) -> None:
    with lock(folder):
        with open(log, "a") as file:
            file.write("in ")
        time.sleep(0.3)
        with open(log, "a") as file:
            file.write("out ")


def test_one_makes_and_the_others_wait(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    runs = [context.Process(target=_hold, args=(tmp_path / "store", tmp_path / "log")) for _ in range(3)]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert (tmp_path / "log").read_text() == "in out " * 3


def test_a_killed_holder_frees_the_lock(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    run = context.Process(target=_hold, args=(tmp_path / "store", tmp_path / "log"))
    run.start()
    while not (tmp_path / "log").exists() or not (tmp_path / "log").read_text():
        time.sleep(0.01)
    assert run.pid
    os.kill(run.pid, 9)
    run.join()
    with lock(tmp_path / "store"):
        pass
    assert (tmp_path / "log").read_text() == "in "


def test_runs_with_a_share_keep_out_those_without(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    with lock(tmp_path / "store", shared=True), lock(tmp_path / "store", shared=True):
        run = context.Process(target=_hold, args=(tmp_path / "store", tmp_path / "log"))
        run.start()
        time.sleep(0.3)
        assert not (tmp_path / "log").exists()
    run.join()
    assert (tmp_path / "log").read_text() == "in out "


def test_a_claim_is_one_process_s(tmp_path: Path) -> None:
    with claim(tmp_path / "x") as ours, claim(tmp_path / "x") as again, claim(tmp_path / "y") as other:
        assert ours and other and not again
    with claim(tmp_path / "x") as ours:
        assert ours


def test_shards_written_elsewhere_are_seen(tmp_path: Path) -> None:
    store = Store.create(tmp_path, "test", CONFIG, 0, 3)
    assert recorded(tmp_path, 1) is None
    shard = write_shard(tmp_path, 1, items(3))
    assert recorded(tmp_path, 1) == shard and shard.memory > 1e6
    assert Store.create(tmp_path, "test", CONFIG, 0, 3, alone=False).missing == [0, 2]
    (tmp_path / shard.file).unlink()
    assert recorded(tmp_path, 1) is None and Store.create(tmp_path, "test", CONFIG, 0, 3).missing == [0, 1, 2]
    store = filled(tmp_path)
    assert recorded(tmp_path, 2) is not None and store.missing == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".manifest.json.lock",
        "manifest.json",
        *(f"shard-0000{i}.tar" for i in range(3)),
    ]


def _write_for_ever(path: Path) -> None:
    temporary(path).write_bytes(b"half")
    time.sleep(600)


def test_what_a_killed_worker_was_writing_is_swept_up_and_nothing_else(tmp_path: Path) -> None:
    worker = multiprocessing.get_context("spawn").Process(target=_write_for_ever, args=(tmp_path / "shard-00000.json",))
    worker.start()
    while not list(tmp_path.glob(".*.tmp")):
        assert worker.is_alive()
        time.sleep(0.01)
    ours = temporary(tmp_path / "shard-00001.json")
    ours.write_bytes(b"half")
    elsewhere = tmp_path / ".shard-00002.json.another-host-7.tmp"
    elsewhere.write_bytes(b"half")
    sweep(tmp_path)
    assert len(list(tmp_path.iterdir())) == 3
    worker.kill()
    worker.join()
    sweep(tmp_path)
    assert set(tmp_path.iterdir()) == {ours, elsewhere}
