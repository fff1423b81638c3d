"""Items of a store that cost nothing: what the laws of making are tried on, in any kind of worker process."""

import time
from functools import partial
from pathlib import Path

import torch

from dexgrasp.dataset.making import Stage
from dexgrasp.dataset.shard import Item
from dexgrasp.seeds import stream


def drawn(seed: int, log: Path | None, pause: float, index: int) -> Item:
    """Return item `index`, drawn from its own stream; adds a line to `log`, and takes `pause` seconds."""
    time.sleep(pause)
    if log is not None:
        with open(log, "a") as file:
            file.write(f"{index}\n")
    generator = stream(seed, "item", index)
    numbers = torch.from_numpy(generator.normal(size=(int(generator.integers(1, 50)), 3)))
    return Item(f"{index:06d}", {"numbers": numbers}, {"sum": float(numbers.sum())})


def stage(count: int, seed: int = 0, log: Path | None = None, pause: float = 0.0) -> Stage:
    """Return a stage of `count` such items."""
    return Stage("test", {"count": count, "seed": seed}, lambda: range(count), partial(drawn, seed, log, pause))
