"""Rates of variants that take turns in one process, in CPU time: their ratio holds on a busy machine too."""

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

SCHEMA = 1
PACKAGES = ("numpy", "scipy", "torch", "numba", "mujoco", "coal")


@dataclass(frozen=True)
class Rate:
    """What one variant does per second of CPU time of one core."""

    median: float
    low: float
    high: float
    """Median, least and largest over the rounds, 1/s."""
    items: int
    """Done in all rounds."""


@dataclass(frozen=True)
class Comparison:
    """Rates of all variants and, round by round, their CPU seconds per item."""

    rates: dict[str, Rate]
    seconds: dict[str, list[float]]

    def ratio(self, ours: str, reference: str) -> tuple[float, float, float]:
        """Return how many times faster `ours` is: median, least and largest of the rounds' ratios."""
        found = [b / a for a, b in zip(self.seconds[ours], self.seconds[reference], strict=True)]
        return statistics.median(found), min(found), max(found)


def compare(variants: Mapping[str, Callable[[], int]], rounds: int = 7, warm: int = 1) -> Comparison:
    """Run every variant once a round, in turn, after `warm` rounds that do not count.

    A variant does its work and returns how many items it did. CPU time of the whole process: one thread, please.
    """
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    items = dict.fromkeys(variants, 0)
    for turn in range(rounds + warm):
        for name, work in variants.items():
            began = time.process_time()
            done = work()
            spent = time.process_time() - began
            if turn >= warm:
                seconds[name].append(spent / done)
                items[name] += done
    rates = {
        name: Rate(1 / statistics.median(values), 1 / max(values), 1 / min(values), items[name])
        for name, values in seconds.items()
    }
    return Comparison(rates, seconds)


def record(
    name: str, figures: Mapping[str, Any], path: str | Path | None, clock: str = "CPU time of one process"
) -> Path:
    """Write a benchmark's figures as JSON, with what they depend on, and return the file; default: <name>.json."""
    file = Path(path) if path else Path(f"{name}.json")
    about = {
        "schema": SCHEMA,
        "benchmark": name,
        "command": " ".join([f"python -m benchmarks.{name}", *sys.argv[1:]]),
        "clock": clock,
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "python": platform.python_version()},
        "packages": {package: version(package) for package in PACKAGES},
    }
    file.write_text(json.dumps(about | {"figures": figures}, indent=1, default=_plain) + "\n", encoding="utf-8")
    return file


def _plain(value: Any) -> Any:
    return asdict(value)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
