"""Child processes that do not outlive their parent, and workers that may keep what they have made."""

import ctypes
import signal
from collections.abc import Iterable, Iterator
from typing import Any

import joblib

ROOM = 8 << 30
"""Bytes by which a worker may grow."""


def end_with_parent() -> None:
    """Have this process killed when its parent ends, even by SIGKILL; a child calls it first (Linux)."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def start_worker() -> None:
    """Prepare a worker process of joblib; its `initializer`.

    Where psutil is installed, loky takes a worker that has grown by 300 MB for one that leaks and starts another, which
    has to load and to make everything anew. Ours keep distance fields and grasps up to a bound of their own.
    """
    end_with_parent()
    from joblib.externals.loky import process_executor

    if hasattr(process_executor, "_MAX_MEMORY_LEAK_SIZE"):
        process_executor._MAX_MEMORY_LEAK_SIZE = ROOM


def in_workers(jobs: Iterable[Any], workers: int) -> Iterator[Any]:
    """Yield the results of joblib's delayed `jobs`, in their order, as so many worker processes make them."""
    yield from joblib.Parallel(n_jobs=workers, return_as="generator", initializer=start_worker)(jobs)
