"""Memory that a process uses over and over."""

import ctypes

TRIM, MAPPED = -1, -3
"""M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of mallopt(3)."""


def keep_freed_memory() -> None:
    """Keep what is freed for what is asked for next, where the C library can (glibc).

    Otherwise it goes back to the system, and the tensors of every training step are made of new pages, which the system
    has to clear one by one.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(MAPPED, 2**25)
        mallopt(TRIM, 2**31 - 1)
