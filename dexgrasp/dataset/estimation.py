"""How long a dataset will take and how much disk it will need, from a small sample of every stage."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch

from dexgrasp.dataset import pipeline, workers
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.making import finished
from dexgrasp.dataset.object_sample import sampled_objects
from dexgrasp.dataset.shard import Item, write_shard
from dexgrasp.dataset.stages import key
from dexgrasp.dataset.store import Store
from dexgrasp.dataset.synthesis_sample import sampled_grasps
from dexgrasp.progress import track

SAMPLE = {"scenes": 16, "views": 16, "verdicts": 1000}
"""Items that are made of each stage, where there are so many; 12 of the others."""


@dataclass(frozen=True)
class Predicted:
    """One row of an estimate."""

    stage: str
    items: int
    seconds: float
    """Wall time with the workers of the config."""
    bytes: float
    basis: str
    """What was measured for it."""
    idle: float = 0.0
    """`seconds`, had the sample had the cores to itself: by processor time."""


@dataclass(frozen=True)
class Timed:
    """One item of a sample, made twice: the second time nothing had to be read or built for the first time."""

    item: Item
    seconds: float
    """Wall time of the second, s."""
    processor: float
    """Processor time of the second, s."""
    built: tuple[float, ...]
    """What each distance field took that was built for it the first time, s."""


def estimate(
    config: Mapping[str, Any], hand: Mapping[str, Any], representation: Mapping[str, Any] | None, seconds: float = 60.0
) -> list[Predicted]:
    """Return what each stage of a dataset will take that is not made yet, with the workers of its config.

    `seconds` is about what the sample of the synthesis, the most uneven stage, may take. Samples are made in a folder
    of their own within the dataset's root, and removed. Raises DexgraspError for bad settings.
    """
    settings, hand = pipeline.plain(config), pipeline.plain(hand)
    told = None if representation is None else pipeline.plain(representation)
    planned = pipeline.plan(settings, hand, told)
    root = Path(settings["root"]).expanduser().absolute()
    root.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    try:
        with (
            tempfile.TemporaryDirectory(prefix=".estimate-", dir=root) as folder,
            workers.pool(settings["backend"], settings["workers"], settings.get("address")) as pool,
        ):
            count = int(settings["workers"] or pool.n_jobs)
            list(pool(joblib.delayed(_ready)() for _ in range(2 * count)))
            started = time.perf_counter() - began
            rows, sample = [], _Sample(settings, hand, told, Path(folder), pool, count, seconds)
            for stage, _, made in planned:
                if finished(made):
                    store = Store.open(made)
                    size = sum(shard["bytes"] for shard in store.manifest["shards"].values())
                    rows.append(Predicted(stage, len(store), 0.0, size, "made already"))
                    sample.dataset.folders[stage] = made
                else:
                    rows.append(sample.row(stage))
    finally:
        if not any(root.iterdir()):
            root.rmdir()
    if all(row.basis == "made already" for row in rows):
        return rows
    return [Predicted("start", count, started, 0, f"{count} workers that have read all code", started), *rows]


class _Sample:
    """Small stores of the stages so far, and what making them says of the large ones."""

    def __init__(
        self,
        settings: dict[str, Any],
        hand: dict[str, Any],
        told: dict[str, Any] | None,
        folder: Path,
        pool: joblib.Parallel,
        workers: int,
        seconds: float,
    ) -> None:
        self.folder, self.pool, self.workers, self.seconds = folder, pool, workers, seconds
        self.dataset = Dataset(settings, hand, {}, told)
        self.objects = 0
        """Of the whole dataset."""
        self.scale = 1.0
        """How many items the whole dataset has for each of the sample."""
        self.charged = False
        """Whether a stage has been charged with the distance fields of all objects."""

    def row(self, stage: str) -> Predicted:
        if stage == "objects":
            found = sampled_objects(self.dataset.config)
            self.objects = found.total
            self.scale = found.total / len(found.items)
            size, factor = float(self.store(stage, found.items)), self.scale
            basis = f"{len(found.items)} of {found.total} objects"
            return Predicted(stage, found.total, factor * found.seconds, factor * size, basis, factor * found.processor)
        self.objects = self.objects or len(self.dataset.store("objects"))
        if stage != "grasps":
            return self._alike(stage)
        guess = sampled_grasps(self.dataset, self.pool, self.workers, self.seconds, self.objects)
        self.scale = self.objects / len(guess.items)
        # What follows knows the objects only whose grasps are there.
        known = self.dataset.store("objects")
        objects = [replace(known[int(item.key)], key=key(i)) for i, item in enumerate(guess.items)]
        self.dataset = Dataset(self.dataset.config, self.dataset.hand_config, {}, self.dataset.representation)
        self.store("objects", objects, "objects-with-grasps")
        size = self.store(stage, [replace(item, key=key(i)) for i, item in enumerate(guess.items)]) * self.scale
        return Predicted(stage, self.objects, guess.seconds, size, guess.basis, guess.processor)

    def _alike(self, name: str) -> Predicted:
        """A stage of many items that are much alike."""
        work = pipeline.work_of(name, {}, self.dataset)
        inputs = work.inputs()
        if name == "scenes":  # the config says how many; what came before counted objects
            self.scale = 1.0
        total = round(len(inputs) * self.scale)
        if not total:
            self.store(name, [])
            return Predicted(name, 0, 0.0, 0.0, "nothing to make")
        chosen = inputs[: SAMPLE.get(name, 12)]
        # Several a task: an item shares with those before it what it will share with them in the real run.
        step = max(4, -(-len(chosen) // (2 * self.workers)))
        pieces = [chosen[start : start + step] for start in range(0, len(chosen), step)]
        tasks = (joblib.delayed(timed)(self.dataset, work.make, list(piece)) for piece in pieces)
        found = [one for piece in track(self.pool(tasks), f"sample of {name}", len(pieces)) for one in piece]
        made = sorted(found, key=lambda one: str(one.item.key))
        size = self.store(name, [one.item for one in made]) * total / len(made)
        if name in ("scenes", "views"):  # what follows is made of the sample
            self.scale = total / len(made)
        if name == "scenes":
            self.dataset.config = {
                **self.dataset.config,
                "scenes": {**self.dataset.config["scenes"], "count": len(made)},
            }
        each, processor = (float(np.mean([getattr(one, kind) for one in made])) for kind in ("seconds", "processor"))
        extra, built = 0.0, [seconds for one in made for seconds in one.built]
        if built and not self.charged:  # every worker builds the fields of all objects, once
            extra, self.charged = float(np.mean(built)) * self.objects, True
        basis = f"{len(made)} of {total}, {each:.3g} s each" + (f"; {extra:.1f} s of distance fields" if extra else "")
        if name == "scenes":
            free = np.mean([one.item.facts["grasps"] for one in made])
            basis += f"; {total * free / 1e6:.3g} M annotations"
        share = total / self.workers
        return Predicted(name, total, share * each + extra, size, basis, share * processor + extra)

    def store(self, stage: str, items: Sequence[Item], name: str | None = None) -> int:
        """Keep a sample as the store of its stage; return its bytes."""
        folder = self.folder / (name or stage)
        store = Store.create(folder, stage, {"objects": self.dataset.config["objects"]}, 0, 1)
        shard = write_shard(folder, 0, items)
        store.finish()
        self.dataset.folders[stage] = folder
        return shard.bytes


def timed(dataset: Dataset, make: Callable[..., Item], values: Sequence[Any]) -> list[Timed]:
    """Make items twice, and time the second round; what a worker does."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    found = []
    try:
        for again in (False, True):
            for place, value in enumerate(values):
                known = max(len(dataset.field.times), 1)  # the first one loads compiled code
                began, before = time.perf_counter(), time.process_time()
                item = make(value)
                seconds, processor = time.perf_counter() - began, time.process_time() - before
                if not again:
                    found.append(Timed(item, seconds, processor, tuple(dataset.field.times[known:])))
                else:
                    found[place] = Timed(item, seconds, processor, found[place].built)
    finally:
        torch.set_num_threads(threads)
    return found


def _ready() -> None:
    """Have a worker read the code of all stages, and take the time that others need to start."""
    import dexgrasp.dataset.stages  # noqa: F401

    time.sleep(0.1)
