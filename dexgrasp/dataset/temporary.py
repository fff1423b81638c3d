"""Names under which files are written before they are whole, and the removal of those that their writer left."""

import os
import socket
from pathlib import Path


def temporary(path: Path) -> Path:
    """Return the name, this process's own, under which the file at `path` is written first."""
    return path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}.tmp")


def sweep(folder: Path) -> None:
    """Remove what processes of this machine were writing into a folder when they were killed."""
    for path in folder.glob(f".*.{socket.gethostname()}-*.tmp"):
        writer = path.name.removesuffix(".tmp").rpartition("-")[2]
        if writer.isdecimal() and not _lives(int(writer)):
            path.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # somebody else's
    return True
