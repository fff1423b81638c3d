"""python -m dexgrasp predict: grasps for one point cloud or depth image."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf

from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.model import load_model
from dexgrasp.report import write_results
from dexgrasp.selection import Selection

Rows = Float[np.ndarray, "P 3"]
KINDS = ".npy, .npz, .ply, .xyz"


def main(config: DictConfig) -> None:
    """Write grasps.npz and results.json, print the best grasps and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    model = load_model(config.model)
    points, normals = read_cloud(Path(config.input))
    selection = Selection(**OmegaConf.to_container(config.selection))  # type: ignore[arg-type]
    began = time.perf_counter()
    grasps = model.predict(points, normals, config.top_k, selection, config.seed)
    seconds = time.perf_counter() - began
    arrays: dict[str, Any] = {name: value.numpy() for name, value in grasps.tensors().items()}
    np.savez(folder / "grasps.npz", **arrays)
    names = model.hand.joint_names
    write_results(
        folder,
        "prediction",
        {
            "title": f"{len(grasps)} grasps for {Path(config.input).name}",
            "model": str(config.model),
            "hand": model.hand.name,
            "joint_names": names,
            "frame": "camera (x right, y down, z forward), metres, radians",
            "seconds": seconds,
            "grasps": [
                {"score": float(g.quality[0]), "pose": g.pose[0].tolist(), "joints": g.joints[0].tolist()}
                for g in (grasps[i] for i in range(len(grasps)))
            ],
        },
    )
    print(table(grasps, names))
    print(f"{len(grasps)} grasps in {seconds:.2f} s\n{folder}")


def read_cloud(path: Path) -> tuple[Rows, Rows | None]:
    """Return points (m, camera frame) and normals where the file has them; `DexgraspError` where it cannot serve."""
    if not path.is_file():
        raise DexgraspError("a point cloud for `input`", f"no file {path}", "check the path")
    try:
        if path.suffix == ".npy":
            return _split(np.load(path))
        if path.suffix == ".npz":
            return _archive(dict(np.load(path)), path)
        if path.suffix in (".ply", ".xyz"):
            loaded: Any = trimesh.load(path, process=False)
            faces = len(getattr(loaded, "faces", ()))
            normals = getattr(loaded, "vertex_normals", None) if faces else None
            return np.asarray(loaded.vertices), None if normals is None else np.asarray(normals)
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise DexgraspError(
            f"a readable point cloud {path}", f"{type(error).__name__}: {error}", "repair it"
        ) from error
    raise DexgraspError(
        f"a file of a known kind ({KINDS})", str(path), "convert it, for example to .npy of shape (P, 3)"
    )


def table(grasps: Grasps, names: tuple[str, ...]) -> str:
    """Return the best grasps as text: score, base position (m), joints (rad or m)."""
    lines = [f"{'score':>7}{'x':>9}{'y':>9}{'z':>9}  " + "".join(f"{name:>12}" for name in names)]
    for i in range(min(len(grasps), 10)):
        place = "".join(f"{value:9.3f}" for value in grasps.pose[i, :3, 3].tolist())
        joints = "".join(f"{value:12.3f}" for value in grasps.joints[i].tolist())
        lines.append(f"{float(grasps.quality[i]):7.3f}{place}  {joints}")
    return "\n".join(lines)


def _archive(arrays: dict[str, np.ndarray], path: Path) -> tuple[Rows, Rows | None]:
    if "points" in arrays:
        return arrays["points"], arrays.get("normals")
    if {"depth", "K"} <= arrays.keys():
        depth, k = arrays["depth"].astype(np.float64), arrays["K"]
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        z = depth[rows, columns]
        return np.stack([(columns - k[0, 2]) / k[0, 0] * z, (rows - k[1, 2]) / k[1, 1] * z, z], axis=1), None
    raise DexgraspError(
        f"points (and perhaps normals), or depth and K, in {path}", f"{sorted(arrays)}", "rename the arrays"
    )


def _split(rows: np.ndarray) -> tuple[Rows, Rows | None]:
    return (rows[:, :3], rows[:, 3:]) if rows.ndim == 2 and rows.shape[1] == 6 else (rows, None)
