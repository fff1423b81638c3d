"""What one camera saw, from a file: a cloud, or a depth image with its intrinsics."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.arrays import load_npy, load_npz
from dexgrasp.sensing.depth_image import KEY, metres, parse_png, unit_of
from dexgrasp.sensing.intrinsics import Intrinsics, read_intrinsics
from dexgrasp.sensing.limits import sized
from dexgrasp.sensing.pcd import parse_pcd
from dexgrasp.sensing.ply import parse_ply

Array = NDArray[np.float64]
KINDS = (".ply", ".pcd", ".npy", ".npz", ".xyz", ".txt", ".png")
NARROWEST = 16
"""Fewest rows and columns of a depth image that says in no other way that it is one."""


@dataclass(frozen=True, eq=False)
class Capture:
    """What one camera saw, as its file tells it."""

    points: Array
    """(P, 3), m; only what was measured."""
    normals: Array | None
    """(P, 3), where the file has them."""
    rows: NDArray[np.int64]
    """(P,) where each point stands in the file: row, or pixel (row * W + column)."""
    total: int
    """Rows or pixels of the file."""
    shape: tuple[int, int] | None = None
    """Height and width where the points are pixels of an image."""
    viewpoint: Array | None = None
    """(3,) where the camera stood in the frame of the points, m, where the file tells it."""

    def __len__(self) -> int:
        return len(self.points)

    def some(self, which: NDArray[Any]) -> "Capture":
        """Return the points of a mask or of indices."""
        normals = None if self.normals is None else self.normals[which]
        return replace(self, points=self.points[which], normals=normals, rows=self.rows[which])


def read_cloud(path: str | Path, scale: float | None = None, intrinsics: Intrinsics | None = None) -> Capture:
    """Return what a file holds.

    Args:
        path: ``.ply``; ``.pcd`` (ascii, binary, compressed); ``.xyz`` or ``.txt`` (x y z, perhaps normals, a line);
            ``.npy`` (P, 3), (P, 6) or (H, W, 3), or a depth image (H, W); ``.npz`` with `points` (or `xyz`) and maybe
            `normals`, or with `depth` (or depth_mm, depth_0p1mm, ...) and maybe `K`; ``.png`` with 16-bit depth. Depth
            is along the optical axis.
        scale: metres per unit of the file; None: clouds are in metres, depth of whole numbers in millimetres, unless
            the array's name tells the unit.
        intrinsics: of a depth image; None: the file must hold them.

    Points without depth (NaN, or zero depth) are left out. Raises DexgraspError for a file that is none of these, is
    larger than `dexgrasp.sensing.limits` allow, or has no point.
    """
    path = Path(path).expanduser()
    kind = path.suffix.lower()
    if not path.exists():
        raise DexgraspError(f"a cloud or depth image: {', '.join(KINDS)}", f"no file {path}", "check the path")
    if kind not in KINDS:
        raise DexgraspError(f"a cloud or depth image: {', '.join(KINDS)}", str(path), "convert the file")
    content = sized(path).read_bytes()
    return parse(content, kind, str(path), scale, intrinsics)


def parse(
    content: bytes, kind: str, where: str, scale: float | None = None, intrinsics: Intrinsics | None = None
) -> Capture:
    """Return what the content of a file of that kind (".ply", ...) holds; as `read_cloud`."""
    if not content:
        raise DexgraspError(f"points in {where}", "an empty file", "measure or write it again")
    shape, viewpoint = None, None
    factor = 1.0 if scale is None else scale
    try:
        if kind == ".pcd":
            rows, shape, viewpoint = parse_pcd(content)
            viewpoint = factor * viewpoint if viewpoint.any() else None
        elif kind == ".ply":
            rows = parse_ply(content)
        elif kind in (".xyz", ".txt"):
            rows = _text(content)
        elif kind == ".png":
            rows, shape = _depth(parse_png(content), scale, intrinsics, where)
            factor = 1.0
        else:
            rows, shape, factor = _arrays(content, kind, scale, intrinsics, where)
    except DexgraspError:
        raise
    except Exception as error:  # NumPy, Pillow and zipfile raise whatever they like for what is no such file
        raise _unreadable(kind, where, error) from error
    with np.errstate(over="ignore", invalid="ignore"):
        points = factor * rows[:, :3]
    # Anything beyond is no measurement, and would overflow.
    measured = np.isfinite(rows).all(axis=1) & (np.abs(points) < 1e9).all(axis=1)
    if not measured.any():
        raise DexgraspError(
            f"points with numbers in {where}",
            f"{len(rows)} points, none of them measured (NaN, infinite, or without depth)",
            "measure again",
        )
    normals = rows[measured, 3:6] if rows.shape[1] >= 6 else None
    return Capture(points[measured], normals, np.flatnonzero(measured), len(rows), shape, viewpoint)


def _unreadable(kind: str, where: str, error: Exception) -> DexgraspError:
    found = " ".join(str(error).split())[:300]
    return DexgraspError(f"a readable {kind} file", f"{where}: {type(error).__name__}: {found}", "write the file again")


def _text(content: bytes) -> Array:
    lines = [line.split(b"#")[0].replace(b",", b" ").split() for line in content.splitlines()]
    lines = [line for line in lines if line]
    width = len(lines[0]) if lines else 0
    if width < 3 or any(len(line) != width for line in lines):
        raise ValueError("lines that are not all of the same three or more numbers")
    rows = np.array(lines, dtype=np.float64)
    # Of four or five numbers the last are colour or intensity.
    return rows[:, :6] if width == 6 else rows[:, :3]


def _arrays(
    content: bytes, kind: str, scale: float | None, intrinsics: Intrinsics | None, where: str
) -> tuple[Array, tuple[int, int] | None, float]:
    """Return rows, the image's shape, and metres per unit of the rows."""
    factor = 1.0 if scale is None else scale
    if kind == ".npy":
        image = load_npy(content)
        if image.ndim == 2 and image.shape[1] in (3, 6):
            return image.astype(np.float64), None, factor
        if image.ndim == 3 and image.shape[2] == 3:
            return image.reshape(-1, 3).astype(np.float64), image.shape[:2], factor
        if image.ndim != 2 or min(image.shape) < NARROWEST:
            raise ValueError(f"an array of shape {image.shape}, not (P, 3), (P, 6), (H, W, 3), or (H, W) of depth")
        return (*_depth(image, scale, intrinsics, where), 1.0)
    arrays = load_npz(content)
    cloud = next((name for name in ("points", "xyz") if name in arrays), None)
    if cloud is not None:
        points = arrays[cloud]
        shape = points.shape[:2] if points.ndim == 3 else None
        rows = points.reshape(-1, 3).astype(np.float64)
        if "normals" in arrays:
            rows = np.hstack([rows, arrays["normals"].reshape(-1, 3).astype(np.float64)])
        return rows, shape, factor
    name = next((name for name in arrays if KEY.fullmatch(name)), None)
    if name is None:
        raise ValueError(f"arrays {sorted(arrays)}, not points (and normals), or depth and K")
    if intrinsics is None and "K" in arrays:
        intrinsics = read_intrinsics(arrays["K"])
    return (*_depth(arrays[name], unit_of(name) if scale is None else scale, intrinsics, where), 1.0)


def _depth(
    image: NDArray[np.generic], scale: float | None, intrinsics: Intrinsics | None, where: str
) -> tuple[Array, tuple[int, int]]:
    depth = metres(image, scale)
    if intrinsics is None:
        raise DexgraspError(
            f"the intrinsics of the depth image {where}",
            "none",
            "tell them: intrinsics=[fx,fy,cx,cy] or intrinsics=camera_info.yaml",
        )
    return intrinsics.points(depth), (depth.shape[0], depth.shape[1])
