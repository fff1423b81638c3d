"""What synthesis will take, although objects differ a hundredfold: a short search on many, the whole one on a few."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import joblib
import numpy as np
import torch

from dexgrasp.dataset import stages
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.distance import DistanceField
from dexgrasp.progress import track
from dexgrasp.seeds import stream

SHORTER = 4
"""The short search wants this much less and may take this many rounds less."""
ROUNDS = 4
"""But not fewer rounds than this."""
LOOKED_AT = 16
"""Objects on which it is tried, at most."""


@dataclass(frozen=True)
class Trial:
    """A search on one object."""

    index: int
    item: Item
    exhausted: bool
    """Whether it ended for want of rounds."""
    setup: float
    """Wall time before the first round, s."""
    seconds: float
    """Wall time in all, s."""
    processor: float
    """Processor time in all, s."""

    @property
    def kept(self) -> int:
        return int(self.item.facts["kept"])


@dataclass(frozen=True)
class Guess:
    """What the grasps of all objects will take."""

    items: list[Item]
    """About as many grasps as each object will have: those found, repeated where the search was short."""
    seconds: float
    """Wall time, with all workers."""
    processor: float
    """The same by processor time."""
    basis: str


def sampled_grasps(dataset: Dataset, pool: joblib.Parallel, workers: int, seconds: float, total: int) -> Guess:
    """Return the estimate for `total` objects, of which `dataset` holds some; its whole searches take `seconds`.

    Objects searched whole are drawn with probability in proportion to what the short search lets expect, so that the
    mean of found / expected, times all that is expected, is without bias (Hansen and Hurwitz 1943). What would take
    longer than all the time there is counts as expected: it ended for want of rounds, whose time grows as they do.
    """
    settings = stages.settings_of(dataset).synthesis
    shorter = max(1, min(SHORTER, settings.rounds // ROUNDS))
    count = len(dataset.store("objects"))
    looked_at = np.unique(np.linspace(0, count - 1, min(count, LOOKED_AT)).round().astype(int)).tolist()
    limits = math.ceil(settings.target / shorter), math.ceil(settings.rounds / shorter)
    short = _searches(dataset, pool, looked_at, limits, "short searches")
    expected = np.array([one.setup + shorter * (one.seconds - one.setup) for one in short])
    possible = np.flatnonzero(expected <= 0.5 * seconds * workers) if shorter > 1 else np.zeros(0, int)
    chosen = _drawn(expected[possible], seconds * workers, dataset.config["seed"])
    number, times = np.unique(possible[chosen], return_counts=True)
    limits = settings.target, settings.rounds
    whole = _searches(dataset, pool, [short[i].index for i in number], limits, "whole searches")
    more, ratio, processor = 1.0, 1.0, 1.0
    if whole:
        weights = times / times.sum()
        ratio = float(weights @ [one.seconds / expected[i] for one, i in zip(whole, number, strict=True)])
        more = sum(one.kept for one in whole) / max(sum(short[i].kept for i in number), 1)
        processor = sum(one.processor for one in whole) / sum(one.seconds for one in whole)
    else:
        processor = sum(one.processor for one in short) / sum(one.seconds for one in short)
        more = float(shorter)
    known = np.zeros(len(short), bool)
    known[possible] = True
    work = (expected[known].sum() * ratio + expected[~known].sum()) / len(short) * total
    # At the end some workers wait for the last objects, half of one's time in the mean.
    wall = work / workers + expected.mean() * ratio * 0.5 * (workers - 1) / workers
    found = {one.index: one.item for one in whole}
    items = [found.get(one.index) or _repeated(one.item, more) for one in short]
    basis = f"{len(short)} of {total} objects for {1 / shorter:.3g} of the grasps, {len(whole)} wholly"
    return Guess(items, wall, wall * processor, basis)


def _searches(
    dataset: Dataset, pool: joblib.Parallel, indices: Sequence[int], limits: tuple[int, int], label: str
) -> list[Trial]:
    tasks = (joblib.delayed(search)(dataset, int(index), *limits) for index in indices)
    found = track(pool(tasks), label, len(indices)) if len(indices) else ()
    return sorted(found, key=lambda one: one.index)


def _drawn(expected: np.ndarray, seconds: float, seed: int) -> np.ndarray:
    """Return which objects are searched wholly, the likelier the longer they take; about `seconds` in all."""
    if not len(expected):
        return np.zeros(0, int)
    # Drawing in proportion to x costs sum(x^2) / sum(x) a draw.
    each = float((expected**2).sum() / expected.sum())
    number = int(np.clip(seconds / each, min(3, len(expected)), len(expected)))
    steps = (np.arange(number) + stream(seed, "estimate").random()) / number
    return np.searchsorted(np.cumsum(expected) / expected.sum(), steps).clip(max=len(expected) - 1)


def search(dataset: Dataset, index: int, target: int, rounds: int) -> Trial:
    """Search the grasps of one object and time it; what a worker does."""
    settings, item = stages.settings_of(dataset).synthesis, dataset.objects[index]
    if not _warm:
        _warm.append(True)
        synthesize(dataset.hand, item, replace(settings, target=1, rounds=1), dataset.config["seed"])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        began = time.perf_counter()
        DistanceField.build(item.mesh)
        setup = time.perf_counter() - began
        settings = replace(settings, target=target, rounds=rounds)
        began, before = time.perf_counter(), time.process_time()
        grasps, summary = synthesize(dataset.hand, item, settings, dataset.config["seed"])
        tensors = grasps.to(torch.float32).tensors()
        seconds, processor = time.perf_counter() - began, time.process_time() - before
    finally:
        torch.set_num_threads(threads)
    exhausted = summary.candidates >= rounds * settings.batch
    facts = {"name": item.name, "kept": len(grasps)}
    return Trial(index, Item(stages.key(index), tensors, facts), exhausted, min(setup, seconds), seconds, processor)


_warm: list[bool] = []
"""Whether this process has loaded all compiled code."""


def _repeated(item: Item, times: float) -> Item:
    """Return an item with its grasps repeated, so that there are `times` as many."""
    count = len(item.tensors["quality"])
    rows = torch.arange(round(count * times)) % max(count, 1)
    return Item(item.key, {name: value[rows] for name, value in item.tensors.items()}, item.facts)
