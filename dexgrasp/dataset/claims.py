"""Who makes what: locks that the kernel drops with their holder, however that ends, so that none can go stale."""

import errno
import fcntl
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger(__name__)
UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def lock(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold the right to make `folder`; others wait, and say for whom.

    `shared` is for runs that make it together: they keep out those that want it alone, not each other. The name in
    the file is for people only.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.with_name(f".{folder.name}.lock")
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    with open(path, "a+") as file:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            log.info("waiting for %s, which is being made by %s", folder, file.read().strip() or "another run")
            started = time.monotonic()
            fcntl.flock(file, kind)
            log.info("waited %.0f s for %s", time.monotonic() - started, folder)
        except OSError as error:
            if error.errno not in UNSUPPORTED:
                raise
            log.warning("%s has no locks: do not make one dataset there with several runs at a time", folder.parent)
            yield
            return
        file.seek(0)
        file.truncate()
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # closing alone would leave it to children that were forked meanwhile


@contextmanager
def claim(path: Path) -> Iterator[bool]:
    """Try to hold `path`, a file made for it; yields whether nobody else does.

    A claim saves work that would be done twice, no more: whoever makes a shard writes the same bytes under a name
    of its own and renames it. So where a file system has no locks, everybody gets what they claim.
    """
    with open(path, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError as error:
            if error.errno not in UNSUPPORTED:
                raise
            yield True
            return
        try:
            yield True
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)
