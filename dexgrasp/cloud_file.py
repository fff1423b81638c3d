"""Point clouds from files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from trimesh.exchange.ply import load_ply

from dexgrasp.errors import DexgraspError

Array = NDArray[np.float64]
KINDS = (".ply", ".pcd", ".npy", ".npz")


def read_cloud(path: Path, scale: float = 1.0) -> tuple[Array, Array | None]:
    """Return points (P, 3) in the camera frame, m, and normals (P, 3) where the file has them.

    Args:
        path: ``.ply``; ``.pcd`` (ascii or binary); ``.npy`` (P, 3) or (P, 6); ``.npz`` with `points` and maybe
            `normals`, or with `depth` (H, W) along the optical axis and the camera matrix `K` (3, 3).
        scale: metres per unit of the file (0.001 for millimetres).

    Points without depth (NaN, or zero depth) are left out. Raises DexgraspError for a file that is none of these.
    """
    if path.suffix not in KINDS:
        raise DexgraspError(f"a cloud: {', '.join(KINDS)}", str(path), "convert the file")
    if not path.is_file():
        raise DexgraspError("a file with a cloud", f"no file {path}", "check the path")
    try:
        rows = {".ply": _ply, ".pcd": _pcd, ".npy": _npy, ".npz": _npz}[path.suffix](path)
    except (ValueError, KeyError, IndexError, EOFError, OSError) as error:
        raise DexgraspError(
            f"a readable {path.suffix} file", f"{path}: {type(error).__name__}: {error}", "write the file again"
        ) from error
    measured = np.isfinite(rows).all(axis=1)
    if not measured.any():
        raise DexgraspError(
            f"points with numbers in {path}", f"{len(rows)}, all of them NaN or infinite", "measure again"
        )
    rows = rows[measured]
    return rows[:, :3] * scale, rows[:, 3:6] if rows.shape[1] >= 6 else None


def _ply(path: Path) -> Array:
    with path.open("rb") as file:
        found = load_ply(file)
    normals = found.get("vertex_normals")
    return np.hstack([found["vertices"], *([] if normals is None else [normals])]).astype(np.float64)


def _npy(path: Path) -> Array:
    rows = np.load(path, allow_pickle=False).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] not in (3, 6):
        raise ValueError(f"an array of shape {rows.shape}, not (P, 3) or (P, 6)")
    return rows


def _npz(path: Path) -> Array:
    with np.load(path, allow_pickle=False) as data:
        if "points" in data:
            points = data["points"].reshape(-1, 3).astype(np.float64)
            return np.hstack([points, data["normals"].reshape(-1, 3)]) if "normals" in data else points
        if not {"depth", "K"} <= set(data):
            raise ValueError(f"arrays {sorted(data)}, not points (and normals), or depth and K")
        depth, camera = data["depth"].astype(np.float64), data["K"].astype(np.float64)
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    rays = np.stack([u, v, np.ones_like(u)], axis=1) @ np.linalg.inv(camera).T
    return rays * depth[v, u, None]


def _pcd(path: Path) -> Array:
    content = path.read_bytes()
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.index(b"\n", start)
        words = content[start:end].decode("ascii").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
        start = end + 1
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    counts = map(int, header.get("COUNT", ["1"] * len(kinds)))
    layout = np.dtype([(n, k, (c,)) for n, k, c in zip(header["FIELDS"], kinds, counts, strict=True)])
    count = int(header["POINTS"][0])
    if header["DATA"] == ["binary"]:
        fields = np.frombuffer(content, layout, count, start)
        columns = {name: fields[name][:, 0] for name in header["FIELDS"]}
    elif header["DATA"] == ["ascii"]:
        table = np.array(content[start:].decode("ascii").split(), dtype=np.float64).reshape(count, -1)
        starts = np.cumsum([0, *(layout[name].shape[0] for name in header["FIELDS"])])
        columns = {name: table[:, at] for name, at in zip(header["FIELDS"], starts, strict=False)}
    else:
        raise ValueError(
            f"DATA {' '.join(header['DATA'])}, not ascii or binary: convert it with pcl_convert_pcd_ascii_binary"
        )
    wanted = ["x", "y", "z"]
    if {"normal_x", "normal_y", "normal_z"} <= columns.keys():
        wanted += ["normal_x", "normal_y", "normal_z"]
    return np.stack([columns[name] for name in wanted], axis=1).astype(np.float64)
