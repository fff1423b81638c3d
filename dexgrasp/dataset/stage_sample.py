"""Some items of a stage, made and written by the workers as the stage itself does it, and what each of them takes."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from numba.core.event import install_timer

from dexgrasp.dataset import pipeline
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import Item, write_shard
from dexgrasp.progress import track
from dexgrasp.threads import one_thread

LIGHT = {"synthesis": {"target": 100, "rounds": 4}, "verify": {"per_object": 1}, "scenes": {"lift_tests": 1}}
"""Settings at most so large show all that a worker does for the first time, in a second."""


@dataclass(frozen=True)
class Piece:
    """What one task of a worker gives. Times are the thread's processor time, s, unless it says otherwise."""

    items: list[Item]
    spent: tuple[float, ...]
    """On each item, its share of writing included, without distance fields that were missing."""
    fields: tuple[tuple[float, int], ...]
    """On each of those, and its bytes."""
    processor: float
    wall: float
    """All of that, and by the clock."""
    once: float | None
    """What the worker's first item of this stage took more than it takes later; None where it was not the first."""


@dataclass(frozen=True)
class Sample:
    """All pieces of one stage."""

    pieces: list[Piece]

    @property
    def items(self) -> list[Item]:
        """All items, by key."""
        return sorted((item for piece in self.pieces for item in piece.items), key=lambda item: item.key)

    @property
    def spent(self) -> np.ndarray:
        """What each item took, s."""
        return np.array([seconds for piece in self.pieces for seconds in piece.spent])

    @property
    def fields(self) -> np.ndarray:
        """(F, 2) what each distance field took, s, and its bytes."""
        return np.array([each for piece in self.pieces for each in piece.fields]).reshape(-1, 2)

    @property
    def once(self) -> float:
        """What a worker's first item took more, s."""
        known = [piece.once for piece in self.pieces if piece.once is not None]
        return float(np.mean(known)) if known else 0.0

    @property
    def processor(self) -> float:
        """Of all pieces, s."""
        return sum(piece.processor for piece in self.pieces)

    @property
    def wall(self) -> float:
        """By the clock, of all pieces, one after another, s."""
        return sum(piece.wall for piece in self.pieces)


def sampled(
    dataset: Dataset,
    name: str,
    pieces: Sequence[Sequence[Any]],
    pool: joblib.Parallel,
    folder: Path,
    seconds: float,
    least: int,
) -> Sample:
    """Make pieces of a stage, in order, at least so many and then until `seconds` of wall time have passed.

    What is begun is finished and counts, so that the mean is without bias although slow items end the sample.
    """
    end = time.perf_counter() + seconds
    folder.mkdir(exist_ok=True)

    def tasks() -> Iterator[Any]:
        for number, piece in enumerate(pieces):
            if number >= least and time.perf_counter() > end:
                return
            yield joblib.delayed(timed)(dataset, name, list(piece), folder, number)

    return Sample(list(track(pool(tasks()), f"sample of {name}")))


@one_thread()
def timed(dataset: Dataset, name: str, values: Sequence[Any], folder: Path, number: int) -> Piece:
    """Make and write items; what a worker does."""
    once, built = None, dataset.field.made
    known = len(built)
    if name not in _warm:
        _warm.add(name)
        once, known = _once(dataset, name, values[0]), known + 1  # the first field loads compiled code
    make = pipeline.work_of(name, {}, dataset).make
    items, spent, wall, processor = [], [], time.perf_counter(), time.thread_time()
    for value in values:
        before, fields = time.thread_time(), len(built)
        items.append(make(value))
        spent.append(time.thread_time() - before - sum(seconds for seconds, _ in built[fields:]))
    before = time.thread_time()
    write_shard(folder, number, items)
    writing = (time.thread_time() - before) / len(items)
    wall, processor = time.perf_counter() - wall, time.thread_time() - processor
    return Piece(items, tuple(each + writing for each in spent), tuple(built[known:]), processor, wall, once)


def _once(dataset: Dataset, name: str, value: Any) -> float:
    """Return what making a light item takes for the first time, less what it takes again, s."""
    config = {group: _light(values, LIGHT.get(group, {})) for group, values in dataset.config.items()}
    light = Dataset(config, dataset.hand_config, dataset.folders, dataset.representation)
    compiling: list[float] = []
    fields = len(dataset.field.made)
    with install_timer("numba:compile", compiling.append):
        began = time.thread_time()
        light.adopt(dataset)
        for shared in ("hand", "shape", "closer"):
            setattr(light, shared, getattr(dataset, shared))
        make = pipeline.work_of(name, {}, light).make
        make(value)
        first = time.thread_time() - began
    apart = sum(compiling) + sum(seconds for seconds, _ in dataset.field.made[fields:])
    began = time.thread_time()
    make(value)
    again = time.thread_time() - began
    # What had to be compiled is cached now, for good; distance fields are counted by themselves.
    return max(first - again - apart, 0.0)


def _light(values: Any, limits: Mapping[str, int]) -> Any:
    if not isinstance(values, Mapping):
        return values
    return {k: min(v, limits[k]) if k in limits and v is not None else v for k, v in values.items()}


_warm: set[str] = set()
"""Stages of which this process has made an item."""
