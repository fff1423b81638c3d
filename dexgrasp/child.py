"""Child processes that do not outlive their parent."""

import ctypes
import signal


def end_with_parent() -> None:
    """Have this process killed when its parent ends, even by SIGKILL; a child calls it first (Linux)."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
