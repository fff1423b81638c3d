"""How long a dataset will take and how much disk it will need, from a small sample of every stage.

Every stage is sampled with the workers of the config side by side, as it will be made, in processor time, which other
programs on the machine change little; the share of a core that the workers had meanwhile gives wall time. What comes
but once - workers that start, code that is loaded, distance fields in each worker - is measured by itself.
"""

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from dexgrasp.dataset import pipeline, workers
from dexgrasp.dataset.dataset import KEPT_FIELDS, Dataset
from dexgrasp.dataset.making import finished
from dexgrasp.dataset.object_sample import sampled_objects, spread_out
from dexgrasp.dataset.shard import Item, write_shard
from dexgrasp.dataset.stage_sample import Sample, sampled
from dexgrasp.dataset.stages import key
from dexgrasp.dataset.store import Store

SHARES = {"grasps": 0.6, "scenes": 0.2}
"""Of the time for the sample; 0.1 for each other stage."""
ITEMS, TOGETHER = 96, 4
"""At most so many items of a stage are made, so many in one task."""


@dataclass(frozen=True)
class Predicted:
    """One row of an estimate."""

    stage: str
    items: int
    seconds: float
    """Wall time with the workers of the config, on a machine as busy as it was while the sample was made."""
    bytes: float
    basis: str
    """What was measured for it."""
    idle: float = 0.0
    """`seconds`, had the workers the cores to themselves."""
    error: float = 0.0
    """Standard error of `seconds` for the items that the sample leaves out."""


def estimate(
    config: Mapping[str, Any], hand: Mapping[str, Any], representation: Mapping[str, Any] | None, seconds: float = 100.0
) -> list[Predicted]:
    """Return what each stage of a dataset will take that is not made yet, with the workers of its config.

    `seconds` is about what the sample may take; a larger one errs less. Samples are made in a folder of their own
    within the dataset's root, and removed. Raises DexgraspError for bad settings.
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
            pool.pre_dispatch = count = int(settings["workers"] or pool.n_jobs)  # so that a sample ends when it should
            list(pool(joblib.delayed(_ready)() for _ in range(2 * count)))
            started = time.perf_counter() - began
            cores = count if settings.get("address") else min(count, joblib.cpu_count())
            rows, sample = [], _Sample(settings, hand, told, Path(folder), pool, cores, seconds)
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
    busy = sample.busy
    rows = [Predicted("start", count, 0.0, 0, f"{count} workers that have read all code", started), *rows]
    found = []
    for row in rows:
        # Start and objects were timed by the clock.
        idle = row.idle / busy if row.stage in ("start", "objects") else row.idle
        found.append(replace(row, idle=idle, seconds=idle * busy, error=row.error * busy))
    return found


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
        self.config = settings
        self.dataset = Dataset(settings, hand, {}, told)
        self.wall = self.processor = 0.0
        """Of the workers' samples, s."""
        self.objects = 0
        """Of the whole dataset."""
        self.charged = False
        """Whether a stage has been charged with the distance fields of all objects."""
        self.uneven = 0.0
        """Standard error of the number of an object's grasps, on which a scene's time depends, over their mean."""

    @property
    def busy(self) -> float:
        """Wall time for each second of processor time."""
        return max(self.wall / self.processor, 1.0) if self.processor else 1.0

    def row(self, stage: str) -> Predicted:
        """Make a sample of a stage that is not made, and return what it says."""
        if stage == "objects":
            found = sampled_objects(self.config)
            self.objects = found.total
            size = self.store(stage, found.items) * found.total / len(found.items)
            basis = f"{len(found.items)} of {found.total} objects"
            return Predicted(stage, found.total, 0.0, size, basis, found.seconds)
        self.objects = self.objects or len(self.dataset.store("objects"))
        scenes = self.config["scenes"]["count"]
        views = scenes * self.config["views"]["per_scene"]
        total = {"scenes": scenes, "views": views, "labels": views}.get(stage, self.objects)
        inputs = list(pipeline.work_of(stage, {}, self.dataset).inputs())
        if not inputs:
            self.store(stage, [])
            return Predicted(stage, 0, 0.0, 0.0, "nothing to make")
        return self._sampled(stage, inputs, total)

    def _sampled(self, stage: str, inputs: list[int], total: int) -> Predicted:
        together = TOGETHER
        if stage in ("grasps", "verdicts"):
            together = 1
        if stage == "grasps":
            inputs = spread_out(list(self.dataset.store("objects")))
        pieces = [inputs[start : start + together] for start in range(0, min(len(inputs), ITEMS), together)]
        # What follows is made of objects with verdicts, and needs several.
        least = {"grasps": 2 * self.workers, "verdicts": len(pieces)}.get(stage, self.workers)
        seconds = SHARES.get(stage, 0.1) * self.seconds
        found = sampled(self.dataset, stage, pieces, self.pool, self.folder / f"written-{stage}", seconds, least)
        self.wall, self.processor = self.wall + found.wall, self.processor + found.processor
        items, spent = found.items, found.spent
        if stage == "grasps":
            items = self._known(items)
        size = self.store(stage, items) * total / len(items)
        if stage == "scenes":
            self.dataset.config = self.config | {"scenes": self.config["scenes"] | {"count": len(items)}}
        workers = min(self.workers, total)
        # At the end some wait for the last shards, half of one's time in the mean.
        last = 0.5 * pipeline.work_of(stage, {}, self.dataset).per_shard(total) * (1 - 1 / workers)
        fields = self._fields(found, total / workers)
        idle = (total / workers + last) * float(spent.mean()) + fields + found.once
        missed = _missed(spent, total)
        if stage == "scenes":  # all of them show the same few objects
            missed = math.hypot(missed, self.uneven * float(spent.mean()))
        basis = f"{len(items)} of {total}, {spent.mean():.3g} s each; {fields + found.once:.1f} s once"
        if stage == "scenes":
            basis += f"; {total * np.mean([item.facts['grasps'] for item in items]) / 1e6:.3g} M annotations"
        return Predicted(stage, total, 0.0, size, basis, idle, total / workers * missed)

    def _known(self, items: Sequence[Item]) -> list[Item]:
        """Go on with those objects alone whose grasps are there; return the grasps, counted anew."""
        kept = np.array([float(item.facts["kept"]) for item in items])
        self.uneven = _missed(kept, self.objects) / max(float(kept.mean()), 1.0)
        objects = [self.dataset.store("objects")[int(item.key)] for item in items]
        self.dataset = Dataset(self.config, self.dataset.hand_config, {}, self.dataset.representation)
        self.store("objects", [replace(item, key=key(i)) for i, item in enumerate(objects)], "objects-with-grasps")
        return [replace(item, key=key(i)) for i, item in enumerate(items)]

    def _fields(self, found: Sample, items: float) -> float:
        """Return what distance fields take each worker of a stage, s; it makes so many items."""
        if self.charged or not len(found.fields):
            return 0.0
        self.charged = True
        seconds, size = found.fields.mean(axis=0)
        met = items * float(np.mean([len(item.facts.get("objects", "?")) for item in found.items]))
        distinct = self.objects * (1 - (1 - 1 / self.objects) ** met)
        dropped = max(1 - KEPT_FIELDS / (size * self.objects), 0.0)
        return float(seconds * (distinct + dropped * (met - distinct)))

    def store(self, stage: str, items: Sequence[Item], name: str | None = None) -> int:
        """Keep a sample as the store of its stage; return its bytes."""
        folder = self.folder / (name or stage)
        store = Store.create(folder, stage, {"objects": self.config["objects"]}, 0, 1)
        shard = write_shard(folder, 0, items)
        store.finish()
        self.dataset.folders[stage] = folder
        return shard.bytes


def _missed(values: np.ndarray, total: int) -> float:
    """Return the standard error of the mean of `total` values of which these were drawn."""
    return float(values.std(ddof=1)) * math.sqrt(1 / len(values) - 1 / total) if len(values) > 1 else 0.0


def _ready() -> None:
    """Have a worker read the code of all stages, and take the time that others need to start."""
    import dexgrasp.dataset.stages  # noqa: F401

    time.sleep(0.1)
