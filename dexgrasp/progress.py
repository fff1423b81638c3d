"""Progress of a long loop: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

T = TypeVar("T")
PAUSE = 10.0
"""Seconds between two lines where output is not a terminal."""


def track(iterable: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Yield from `iterable` and show `label`, count, rate and time left on standard error."""
    if total is None and isinstance(iterable, Sized):
        total = len(iterable)
    return _bar(iterable, label, total) if sys.stderr.isatty() else _lines(iterable, label, total)


def _bar(iterable: Iterable[T], label: str, total: int | None) -> Iterator[T]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.3g}/s" if task.speed else "")

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn()]
    with Progress(*columns, console=Console(stderr=True)) as progress:
        yield from progress.track(iterable, total=total, description=label)


def _lines(iterable: Iterable[T], label: str, total: int | None) -> Iterator[T]:
    start = last = time.monotonic()
    done = 0
    for item in iterable:
        yield item
        done += 1
        now = time.monotonic()
        if now - last >= PAUSE and done != total:
            last = now
            print(_line(label, done, total, now - start), file=sys.stderr, flush=True)
    if done or total != 0:
        print(_line(label, done, done, time.monotonic() - start), file=sys.stderr, flush=True)


def _line(label: str, done: int, total: int | None, elapsed: float) -> str:
    rate = done / max(elapsed, 1e-9)
    if total is None:
        return f"{label}: {done}, {rate:.3g}/s"
    if done == total:
        return f"{label}: {done} in {elapsed:.1f} s, {rate:.3g}/s"
    left = (total - done) / rate if done else float("inf")
    return f"{label}: {done}/{total}, {rate:.3g}/s, {left:.0f} s left"
