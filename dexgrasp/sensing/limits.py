"""How large an input may be: what is larger is refused before it is read."""

from pathlib import Path

from dexgrasp.errors import DexgraspError

FILE = 1 << 30
"""Bytes of a cloud, an image, a grasp file of tensors."""
GRASPS = 256 << 20
"""Bytes of a grasp file that is text or a pickle."""
TEXT = 16 << 20
"""Bytes of intrinsics, poses, and other small texts."""
POINTS = 50_000_000
"""Points of one cloud, pixels of one image."""


def sized(path: Path, most: int = FILE) -> Path:
    """Return `path` where it is a file of at most `most` bytes; raises DexgraspError for others."""
    if not path.is_file():
        raise DexgraspError("a file", f"no file {path}", "check the path")
    size = path.stat().st_size
    if size > most:
        raise DexgraspError(f"at most {most / 2**20:.0f} MiB in {path}", f"{size / 2**20:.0f} MiB", "crop or thin it")
    return path


def head(path: Path, count: int) -> bytes:
    """Return the first `count` bytes of a file, however large it is."""
    with path.open("rb") as file:
        return file.read(count)


def counted(count: int, where: str) -> int:
    """Return `count` where so many points or pixels may be; raises DexgraspError for others."""
    if not 0 <= count <= POINTS:
        raise DexgraspError(f"at most {POINTS} points or pixels in {where}", str(count), "crop or thin it")
    return count
