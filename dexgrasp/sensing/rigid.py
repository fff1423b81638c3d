"""Rigid motions that a user tells: a 4x4 matrix or position and quaternion, on the command line or in a file."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.arrays import load_npy
from dexgrasp.sensing.limits import TEXT, sized
from dexgrasp.sensing.plain_yaml import read_yaml

Array = NDArray[np.float64]
ORDERS = ("wxyz", "xyzw")
RIGID = 1e-3


def read_rigid(told: Any, what: str, order: str = "wxyz") -> Array:
    """Return one motion (4, 4), m.

    Args:
        told: 16 numbers row by row, [[...], ...], or 7: x y z and a quaternion; or a file that holds such (.npy, .json,
            .yaml, .txt).
        what: for the messages, e.g. "camera_to_base".
        order: of the quaternion's numbers, "wxyz" or "xyzw".

    Raises DexgraspError for what is no rigid motion in metres.
    """
    found = read_rigids(told, what, order)
    if len(found) != 1:
        raise DexgraspError(f"{what}: one motion", f"{len(found)}", "give one")
    return found[0]


def read_rigids(told: Any, what: str, order: str = "wxyz") -> Array:
    """Return motions (N, 4, 4), m; `told` as in `read_rigid`, or a list of such; raises DexgraspError."""
    if order not in ORDERS:
        raise DexgraspError(f"an order of quaternions: {' or '.join(ORDERS)}", repr(order), "tell it: quaternion=wxyz")
    if isinstance(told, str | Path):
        told = _file(Path(told).expanduser(), what)
    elif isinstance(told, list) and told and all(isinstance(each, str) for each in told):
        return np.concatenate([read_rigids(each, what, order) for each in told])
    try:
        numbers = np.asarray(told, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise _wrong(what, f"{type(told).__name__}: {error}") from error
    if numbers.size and numbers.size % 16 == 0 and numbers.shape[-1:] in ((4,), (16,)):
        return _checked(numbers.reshape(-1, 4, 4), what)
    if numbers.size and numbers.shape[-1:] == (7,):
        return _checked(_joined(numbers.reshape(-1, 7), what, order), what)
    raise _wrong(what, f"numbers of shape {numbers.shape}")


def quaternion_of(rotation: Array, order: str = "wxyz") -> list[float]:
    """Return the quaternion of a rotation (3, 3), its scalar part not negative."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=order == "wxyz")
    return [float(value) for value in turned]


def _joined(rows: Array, what: str, order: str) -> Array:
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(rows[:, 3:], axis=1)
    if not (np.abs(length - 1) < 0.01).all():
        raise _wrong(what, f"a quaternion ({order}) of length {length[np.argmax(np.abs(length - 1))]:.4g}, not 1")
    motions = np.tile(np.eye(4), (len(rows), 1, 1))
    motions[:, :3, :3] = Rotation.from_quat(rows[:, 3:], scalar_first=order == "wxyz").as_matrix()
    motions[:, :3, 3] = rows[:, :3]
    return motions


def _file(path: Path, what: str) -> Any:
    sized(path, TEXT)
    try:
        if path.suffix == ".npy":
            return load_npy(path.read_bytes())
        text = path.read_text()
        if path.suffix == ".json":
            return _inside(json.loads(text))
        if path.suffix in (".yaml", ".yml"):
            return _inside(read_yaml(text))
        rows = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
        return np.array([row for row in rows if row], dtype=np.float64)
    except Exception as error:  # whatever is wrong in such a file
        raise _wrong(what, f"{path}: {type(error).__name__}: {error}") from error


def _inside(content: Any) -> Any:
    """Return the numbers, or those under a key that says what they are."""
    if isinstance(content, dict):
        return next((content[key] for key in ("matrix", "transform", "pose", "poses", "T") if key in content), content)
    return content


def _checked(motions: Array, what: str) -> Array:
    rotation = motions[:, :3, :3]
    if not np.isfinite(motions).all() or np.abs(motions).max() > 1e6:
        raise _wrong(what, "numbers that are NaN, infinite or huge")
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max()
    if off > RIGID or (np.linalg.det(rotation) < 0).any() or np.abs(motions[:, 3] - [0, 0, 0, 1]).max() > RIGID:
        raise _wrong(what, f"a matrix that is no rigid motion (its rotation is off by {off:.2g}, or mirrors)")
    if np.linalg.norm(motions[:, :3, 3], axis=1).max() > 50:
        raise DexgraspError(f"{what}: a translation in metres", "one of more than 50 m", "tell metres, not millimetres")
    u, _, v = np.linalg.svd(rotation)
    motions = motions.copy()
    motions[:, :3, :3] = u @ v  # exact, however few digits the file has
    return motions


def _wrong(what: str, found: str) -> DexgraspError:
    return DexgraspError(
        f"{what}: a 4x4 matrix, or x y z and a unit quaternion, inline or in a .npy, .json, .yaml or .txt file",
        found,
        "see docs/predict.md",
    )
