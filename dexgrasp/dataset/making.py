"""Making one store: its missing shards, by the workers of this run and of all runs that work on it."""

import logging
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib

from dexgrasp.dataset.claims import claim, lock
from dexgrasp.dataset.shard import Item, Shard, shard_name, write_shard
from dexgrasp.dataset.store import Store, recorded
from dexgrasp.dataset.temporary import sweep
from dexgrasp.errors import DexgraspError
from dexgrasp.progress import track
from dexgrasp.threads import one_thread

PAUSE = 0.5
"""Seconds between two looks at shards that other runs are making."""
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Share:
    """Which part of the work a run begins with, where several make one dataset: shard i is part i modulo `parts`'s.

    A run that is through with its own goes on with what nobody works on, so one that never starts holds up none.
    """

    part: int = 0
    parts: int = 1

    def __post_init__(self) -> None:
        if not (type(self.part) is type(self.parts) is int and 0 <= self.part < self.parts):
            found = f"part={self.part} parts={self.parts}"
            raise DexgraspError("whole numbers 0 <= part < parts", found, "e.g. -m 'part=range(0,8)' parts=8")

    def order(self, shards: Sequence[int]) -> list[int]:
        """Return shards in the order in which this run takes them up: its own, then those of the next part."""
        return sorted(shards, key=lambda i: ((i - self.part) % self.parts, i))


@dataclass(frozen=True)
class Stage:
    """What a store is made of."""

    name: str
    content: Mapping[str, Any]
    """Everything that its items follow from."""
    inputs: Callable[[], Sequence[Any]]
    """Gives what `make` is called with, item by item."""
    make: Callable[..., Item]
    whole: bool = False
    """Made by one run in its own process: few items that lie in its memory."""

    def per_shard(self, count: int) -> int:
        """Return the number of items in a shard, the same for any number of workers.

        Small enough to keep every worker busy, large enough not to litter; what is slow to make stands alone.
        """
        return min(max(math.ceil(count / (512 if self.name in ("objects", "grasps") else 32)), 1), 16)


def finished(folder: Path) -> bool:
    """Tell whether a store is there with all its shards."""
    if not (folder / "manifest.json").exists():
        return False
    store = Store.open(folder, complete=False)
    return store.complete and "seconds" in store.manifest


def make_store(folder: Path, stage: Stage, seed: int, start: Callable[[], joblib.Parallel], share: Share) -> None:
    """Make what is missing of a store; returns when it is complete, whoever made it.

    `start` gives the workers when they are needed. Alone, or for a `whole` stage, the run keeps others out.
    """
    if finished(folder):
        return
    work = stage.inputs()
    alone = stage.whole or share.parts == 1
    with lock(folder, shared=not alone):
        if finished(folder):
            return
        per_shard = stage.per_shard(len(work))
        count = math.ceil(len(work) / per_shard)
        store = Store.create(folder, stage.name, stage.content, seed, count, alone)
        if count:
            log.info("making %s in %s: %d of %d shards are missing", stage.name, folder, len(store.missing), count)
        began = time.perf_counter()
        pieces = {i: work[i * per_shard : (i + 1) * per_shard] for i in store.missing}
        shards = _shards(store, stage, pieces, start, share)
        try:
            for _ in track((None for shard in shards for _ in shard.items), stage.name, sum(map(len, pieces.values()))):
                pass
        finally:
            shards.close()  # ends the workers; one that was killed while it wrote could not clear up
            sweep(folder)
        store.finish(time.perf_counter() - began)


def _shards(
    store: Store, stage: Stage, pieces: Mapping[int, Sequence[Any]], start: Callable[[], joblib.Parallel], share: Share
) -> Generator[Shard, None, None]:
    """Yield all missing shards as they come to be there."""
    while store.missing:
        tasks = ((store.folder, i, stage.make, pieces[i]) for i in share.order(store.missing))
        results = (make_shard(*task) for task in tasks) if stage.whole else start()(map(_delayed, tasks))
        claimed, progress = [], False
        for index, shard in results:
            if shard is None:
                claimed.append(index)
                continue
            progress = True
            store.add(index, shard)
            yield shard
        for index in claimed:
            shard = recorded(store.folder, index)
            if shard is not None:
                progress = True
                store.add(index, shard)
                yield shard
        if not progress:
            time.sleep(PAUSE)


def _delayed(task: tuple[Any, ...]) -> Any:
    return joblib.delayed(make_shard)(*task)


@one_thread()
def make_shard(folder: Path, index: int, make: Callable[..., Item], inputs: Sequence[Any]) -> tuple[int, Shard | None]:
    """Make one shard, or find it made; None where another process is at it. The workers' only entry."""
    with claim(folder / f".{shard_name(index)}.claim") as ours:
        if not ours:
            return index, None
        made = recorded(folder, index)
        if made is None:
            items = (make(*value) if isinstance(value, tuple) else make(value) for value in inputs)
            made = write_shard(folder, index, items)
        return index, made
