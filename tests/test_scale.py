"""One store, whoever makes it: the same bytes from every backend, several runs at once, and runs that are killed."""

import errno
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from dexgrasp.dataset import shard as shard_module
from dexgrasp.dataset import workers
from dexgrasp.dataset.claims import claim
from dexgrasp.dataset.kept import Kept
from dexgrasp.dataset.making import Share, make_store
from dexgrasp.dataset.store import Store
from dexgrasp.errors import DexgraspError
from dexgrasp.testing.items import stage

COUNT = 40


def made(folder: Path, backend: str = "loky", count: int = 1, share: Share | None = None, **options) -> Path:
    with workers.pool(backend, count) as pool:
        make_store(folder, stage(COUNT, **options), 0, lambda: pool, share or Share())
    return folder


def hashes(folder: Path) -> dict[str, str]:
    assert Store.open(folder).verify() == len(list(folder.glob("*.tar")))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.tar")}


@pytest.fixture(scope="module")
def wanted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    found = hashes(made(tmp_path_factory.mktemp("wanted") / "store"))
    assert len(found) == 20
    return found


@pytest.mark.parametrize(
    ("backend", "count"),
    [
        ("loky", 2),
        ("threading", 3),
        pytest.param("dask", 2, marks=pytest.mark.slow),
        pytest.param("ray", 2, marks=pytest.mark.slow),
    ],
)
def test_same_bytes_from_every_backend(backend: str, count: int, wanted: dict[str, str], tmp_path: Path) -> None:
    if backend in ("dask", "ray"):
        pytest.importorskip(backend)
    log = tmp_path / "log"
    assert hashes(made(tmp_path / "store", backend, count, log=log)) == wanted
    assert Counter(log.read_text().split()) == {str(i): 1 for i in range(COUNT)}


def test_runs_share_the_work_and_make_nothing_twice(wanted: dict[str, str], tmp_path: Path) -> None:
    log = tmp_path / "log"
    runs = [
        threading.Thread(target=made, args=(tmp_path / "store", "threading", 1, Share(part, 3)), kwargs={"log": log})
        for part in range(3)
    ]
    for run in runs:
        run.start()
    for run in runs:
        run.join()
    assert hashes(tmp_path / "store") == wanted
    assert Counter(log.read_text().split()) == {str(i): 1 for i in range(COUNT)}


def test_a_run_waits_for_what_another_makes_and_makes_what_nobody_makes(wanted: dict[str, str], tmp_path: Path) -> None:
    folder, log = tmp_path / "store", tmp_path / "log"
    folder.mkdir()
    run = threading.Thread(target=made, args=(folder, "threading", 1, Share(0, 2)), kwargs={"log": log})
    with claim(folder / ".shard-00003.tar.claim") as ours:
        assert ours
        run.start()
        until = time.monotonic() + 300
        while len(list(folder.glob("*.tar"))) < 19 and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(0.3)
        assert len(list(folder.glob("*.tar"))) == 19 and run.is_alive()
    run.join(timeout=300)
    assert hashes(folder) == wanted
    order = log.read_text().split()
    assert order.index("4") < order.index("2"), "shards of the own part come first"


def test_a_full_disk_loses_nothing(wanted: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, log, sync = tmp_path / "store", tmp_path / "log", os.fsync
    room = [0]

    def fsync(descriptor: int) -> None:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "no space left on device")
        sync(descriptor)

    monkeypatch.setattr(shard_module.os, "fsync", fsync)
    for _ in range(30):
        room[0] = 17
        try:
            made(folder, log=log)
            break
        except DexgraspError as error:
            assert "full" in str(error)
            assert not list(folder.glob(".*.tmp"))
    else:
        pytest.fail("never done")
    assert hashes(folder) == wanted
    # Only the shard of two items that met the end each time is made again.
    assert sum(Counter(log.read_text().split()).values()) <= COUNT + 2 * 10


KILLED = """
import sys
from pathlib import Path
from dexgrasp.dataset import workers
from dexgrasp.dataset.making import Share, make_store
from dexgrasp.testing.items import stage
with workers.pool("loky", 2) as pool:
    make_store(Path(sys.argv[1]), stage(40, log=Path(sys.argv[2]), pause=0.05), 0, lambda: pool, Share())
"""


@pytest.mark.parametrize("kills", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_killed_at_any_moment_it_goes_on(kills: int, wanted: dict[str, str], tmp_path: Path) -> None:
    folder, log = tmp_path / "store", tmp_path / "log"
    command = [sys.executable, "-c", KILLED, str(folder), str(log)]
    moments = np.random.default_rng(0).uniform(0.0, 0.2, kills)
    seen: dict[str, int] = {}
    for moment in moments:
        before = len(list(folder.glob("*.tar")))
        run = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        until = time.monotonic() + 300
        while len(list(folder.glob("*.tar"))) == before and run.poll() is None and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(moment)
        os.kill(run.pid, signal.SIGKILL)
        run.wait()
        for path in folder.glob("*.json"):
            if path.stem in seen:
                assert path.stat().st_mtime_ns == seen[path.stem], "what was done is not made again"
            seen[path.stem] = path.stat().st_mtime_ns
        time.sleep(0.2)  # workers end with their parent
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    assert hashes(folder) == wanted
    assert not list(folder.glob(".*.tmp")) and not list(folder.glob(".*.claim"))
    # At each end two workers had a shard of two items in hand.
    assert sum(Counter(log.read_text().split()).values()) <= COUNT + kills * 4


@pytest.mark.parametrize(("part", "parts"), [(2, 2), (-1, 3), (0, 0), (0.0, 1)])
def test_shares_are_whole(part: int, parts: int) -> None:
    with pytest.raises(DexgraspError, match="part"):
        Share(part, parts)


def test_shares_take_up_their_own_first() -> None:
    assert Share(1, 3).order(range(8)) == [1, 4, 7, 2, 5, 0, 3, 6]
    assert Share().order([5, 2, 7]) == [2, 5, 7]


def test_bad_backends_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DexgraspError, match="loky, threading, ray, dask"):
        workers.check("slurm", None, None)
    with pytest.raises(DexgraspError, match="address"):
        workers.check("loky", "10.0.0.1:6379", None)
    with pytest.raises(DexgraspError, match="workers"):
        workers.check("loky", None, 0)
    for name, module in (("ray", "ray"), ("dask", "distributed")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(DexgraspError, match="not installed") as error:
            workers.check(name, None, 2)
        assert f"dexgrasp[{name}]" in error.value.remedy


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_named() -> None:
    pytest.importorskip("distributed")
    refused = workers.pool("dask", None, "tcp://127.0.0.1:1")
    with pytest.raises(DexgraspError, match=r"127\.0\.0\.1:1"), refused:
        pass


def test_kept_values_are_bounded_by_bytes() -> None:
    asked: list[int] = []

    @cache
    def value(key: int) -> tuple[np.ndarray, torch.Tensor]:
        return np.zeros(100), torch.zeros(key)

    kept = Kept(lambda key: asked.append(key) or value(key), 3300)
    for key in (0, 10, 20, 0, 400, 0, 10):
        assert kept(key) is value(key)
        assert kept.bytes <= 3300
    assert asked == [0, 10, 20, 400, 10]
    assert len(kept(5000)[1]) == 5000, "one is kept, however large"
