"""A pinhole camera: inline, as JSON, or as ROS tells it (camera_info)."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.arrays import load_npy
from dexgrasp.sensing.limits import TEXT, sized
from dexgrasp.sensing.plain_yaml import read_yaml

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Intrinsics:
    """Focal lengths and principal point, pixels; the middle of the first pixel is at (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int] | None = None
    """Height and width of the images it is for, where it says."""

    def __post_init__(self) -> None:
        numbers = np.array([self.fx, self.fy, self.cx, self.cy])
        if not np.isfinite(numbers).all() or min(self.fx, self.fy) < 1 or np.abs(numbers).max() > 1e6:
            raise _wrong(f"fx, fy, cx, cy = {numbers.tolist()}")

    def points(self, depth: Array) -> Array:
        """Return (H * W, 3) points, m, of a depth image along the optical axis; NaN where nothing was measured."""
        if self.size is not None and depth.shape != self.size:
            raise DexgraspError(
                f"a depth image of {self.size[0]} rows and {self.size[1]} columns, as the intrinsics say",
                f"{depth.shape[0]} and {depth.shape[1]}",
                "give the intrinsics of this stream",
            )
        z = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        return np.stack([(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z], axis=-1).reshape(-1, 3)


def read_intrinsics(told: Any) -> Intrinsics:
    """Return the camera of [fx, fy, cx, cy], a matrix K (nested or 9 numbers), a mapping of such, or a file of one.

    Files: JSON with fx, fy, cx, cy (or ppx, ppy) or K, or Open3D's intrinsic_matrix (column by column); YAML of ROS:
    camera_info's k (ROS 2) or K (ROS 1), or camera_matrix of camera_calibration. Where ROS tells P, P is taken: it is
    the rectified image's camera. Raises DexgraspError for anything else.
    """
    where = "intrinsics"
    if isinstance(told, str | Path):
        where, told = str(told), _file(Path(told).expanduser())
    try:
        return _mapped(told) if isinstance(told, dict) else _matrix(told)
    except (TypeError, ValueError, KeyError, IndexError, OverflowError) as error:
        raise _wrong(f"{type(error).__name__}: {error} in {where}") from error


def _mapped(told: dict[Any, Any]) -> Intrinsics:
    size = None
    height, width = (told.get(key, told.get(f"image_{key}")) for key in ("height", "width"))
    if height is not None and width is not None and int(height) > 0:
        size = int(height), int(width)
    if "intrinsic_matrix" in told:  # Open3D: column by column
        return _matrix(np.asarray(told["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T, size)
    for key in ("p", "P", "projection_matrix", "k", "K", "camera_matrix"):
        value = told.get(key)
        value = value.get("data") if isinstance(value, dict) else value
        if value is not None and np.asarray(value, dtype=np.float64).any():
            return _matrix(value, size)
    if {"fx", "fy"} <= told.keys():
        centre = [float(told[key if key in told else other]) for key, other in (("cx", "ppx"), ("cy", "ppy"))]
        return Intrinsics(float(told["fx"]), float(told["fy"]), centre[0], centre[1], size)
    nested = next(
        (told[key] for key in ("intrinsics", "depth", "camera_info") if isinstance(told.get(key), dict)), None
    )
    if nested is None:
        raise ValueError(f"keys {', '.join(map(str, told))[:200]}")
    return _mapped(nested)


def _matrix(told: Any, size: tuple[int, int] | None = None) -> Intrinsics:
    numbers = np.asarray(told, dtype=np.float64)
    if numbers.shape == (4,):
        fx, fy, cx, cy = map(float, numbers)
        return Intrinsics(fx, fy, cx, cy, size)
    if numbers.size not in (9, 12):
        raise ValueError(f"{numbers.size} numbers")
    matrix = numbers.reshape(3, -1)
    lower = matrix[[0, 1, 2, 2], [1, 0, 0, 1]]
    if np.abs(lower).max() > 1e-6 * np.abs(matrix).max() or abs(matrix[2, 2] - 1) > 1e-6:
        raise ValueError(f"no camera matrix: {matrix[:, :3].tolist()}")
    return Intrinsics(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2]), size)


def _file(path: Path) -> Any:
    sized(path, TEXT)
    try:
        if path.suffix == ".npy":
            return load_npy(path.read_bytes())
        text = path.read_text()
        return json.loads(text) if path.suffix == ".json" else read_yaml(text)
    except Exception as error:  # whatever is wrong in such a file
        raise _wrong(f"{path}: {type(error).__name__}: {error}") from error


def _wrong(found: str) -> DexgraspError:
    return DexgraspError(
        "intrinsics: [fx, fy, cx, cy] in pixels, a 3x3 matrix K, or a JSON or ROS camera_info YAML file with one",
        found,
        "e.g. intrinsics=[615.3,615.5,320.1,241.9] or intrinsics=camera_info.yaml",
    )
