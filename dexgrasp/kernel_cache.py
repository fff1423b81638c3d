"""Where numba keeps compiled code: apart for every state of the sources.

numba takes cached code as valid while the file that defines a function is unchanged, though code of other files is
compiled into it: after an update of some of the files, stale machine code would run, or crash.
"""

import contextlib
import hashlib
import os
import shutil
import sys
from pathlib import Path

KEPT = 12
"""States of the sources whose code is kept, the latest ones."""


def cold() -> bool:
    """Tell whether nothing is compiled yet: the first command of a new installation, or after an update."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    return folder.is_dir() and next(folder.rglob("*.nbi"), None) is None


def separate(package: Path) -> None:
    """Give compiled code of `package` a folder of its own in the user's cache, unless NUMBA_CACHE_DIR says where.

    Must come before compiled functions are defined. Where no folder can be made, numba's own rules stay.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    texts = (file.read_bytes() for file in sorted(package.rglob("*.py")))
    state = hashlib.sha256(b"".join(text for text in texts if b"njit" in text)).hexdigest()[:16]
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dexgrasp" / "numba"
    folder = home / state
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)  # workers inherit it
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    with contextlib.suppress(OSError):  # another process may be tidying, too
        for old in sorted(home.iterdir(), key=lambda path: -path.stat().st_mtime)[KEPT:]:
            shutil.rmtree(old, ignore_errors=True)
