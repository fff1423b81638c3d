"""python -m dexgrasp predict: grasps for one point cloud or depth image."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from dexgrasp.cloud_file import read_cloud
from dexgrasp.grasps import Grasps
from dexgrasp.model import load_model
from dexgrasp.report import write_results
from dexgrasp.selection import Selection
from dexgrasp.settings import read


def main(config: DictConfig) -> None:
    """Write grasps.npz and results.json, print the best grasps and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    model = load_model(config.model)
    points, normals = read_cloud(Path(config.input), config.scale)
    selection = read(Selection, config.selection, "selection")
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
            "grasps": [_told(grasps[i], [finger.name for finger in model.hand.fingers]) for i in range(len(grasps))],
        },
    )
    print(table(grasps, names))
    print(f"{len(grasps)} grasps in {seconds:.2f} s\n{folder}")


def _told(grasp: Grasps, fingers: list[str]) -> dict[str, Any]:
    return {
        "score": float(grasp.quality[0]),
        "pose": grasp.pose[0].tolist(),
        "joints": grasp.joints[0].tolist(),
        "fingers": [name for name, touches in zip(fingers, grasp.touching[0].tolist(), strict=True) if touches],
    }


def table(grasps: Grasps, names: tuple[str, ...]) -> str:
    """Return the best grasps as text: score, base position (m), joints (rad or m)."""
    lines = [f"{'score':>7}{'x':>9}{'y':>9}{'z':>9}  " + "".join(f"{name:>12}" for name in names)]
    for i in range(min(len(grasps), 10)):
        place = "".join(f"{value:9.3f}" for value in grasps.pose[i, :3, 3].tolist())
        joints = "".join(f"{value:12.3f}" for value in grasps.joints[i].tolist())
        lines.append(f"{float(grasps.quality[i]):7.3f}{place}  {joints}")
    return "\n".join(lines)
