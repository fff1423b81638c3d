"""Views as WebDataset: tar shards with one sample a view, which the package `webdataset` decodes as they stand."""

import io
import json
import os
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import append, write_whole
from dexgrasp.errors import DexgraspError
from dexgrasp.progress import track

PER_TAR = 100
"""Views in a tar."""
FRAMES = {
    "points.npy": "(N, 3) float32, m, camera frame: x right, y down, z forward",
    "normals.npy": "(N, 3) float32, unit, estimated from the cloud, towards the camera",
    "instance.npy": "(N,) int16, object of the scene; -1 table and background",
    "camera.npy": "(4, 4) world_T_camera, m; world: z up, table at z = 0",
    "grasps.npz": "feasible grasps of the scene, camera frame: pose (G, 4, 4) camera_T_base, joints (G, J) rad, "
    "contacts (G, F, 3) m, normals (G, F, 3), NaN where a finger does not touch, finger (G,), object (G,) as instance, "
    "quality (G,) epsilon, touching (G, F) which fingers close",
    "labels.npz": "where the dataset has labels: as dexgrasp.dataset.labels.Labels",
    "json": "scene, names of its objects",
}
"""Members of a sample by extension."""


def export_webdataset(dataset: Dataset, folder: Path) -> list[Path]:
    """Write every view with the feasible grasps of its scene; returns the files, a README first.

    Whole files that are there already are kept, so an export that was interrupted goes on. Training and validation
    views lie in files of their own, `train-<n>.tar` and `validation-<n>.tar`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    readme = folder / "README.md"
    joints = ", ".join(dataset.hand_config.get("joints", ())) or "in the order of the hand's joint_names"
    lines = [f"# Views of dataset {dataset.config['name']}, hand {dataset.hand_config['name']}", ""]
    lines += ["Metres, radians. Keys of a sample:", "", *(f"- `{name}`: {text}" for name, text in FRAMES.items())]
    write_whole(readme, "\n".join([*lines, "", f"Joints: {joints}.", ""]).encode())
    written = [readme]
    for split in ("train", "validation"):
        views = dataset.split(split)
        pieces = [views[start : start + PER_TAR] for start in range(0, len(views), PER_TAR)]
        for number, piece in enumerate(track(pieces, f"export, {split}")):
            path = folder / f"{split}-{number:06d}.tar"
            if not path.exists():
                _write(dataset, piece, path)
            written.append(path)
    if len(written) == 1:
        raise DexgraspError("a dataset with views", "none", "make it with views.per_scene of at least 1")
    return written


def _write(dataset: Dataset, views: Any, path: Path) -> None:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for view in views:
            for name, content in _sample(dataset, view).items():
                append(tar, f"{view:08d}.{name}", content)
    write_whole(path, buffer.getbuffer())
    os.chmod(path, 0o644)


def _sample(dataset: Dataset, index: int) -> dict[str, bytes]:
    view, number = dataset.view(index), dataset.scene_of(index)
    grasps = {name: value.numpy() for name, value in dataset.view_grasps(index).tensors().items()}
    facts = {"view": index, "scene": number, "objects": list(dataset.scene(number).objects)}
    sample = {
        "points.npy": _npy(view.points.numpy()),
        "normals.npy": _npy(view.normals.numpy()),
        "instance.npy": _npy(view.instance.numpy().astype(np.int16)),
        "camera.npy": _npy(view.world_T_camera.numpy()),
        "grasps.npz": _npz(grasps),
        "json": json.dumps(facts).encode(),
    }
    if "labels" in dataset.folders:
        sample["labels.npz"] = _npz({k: v.numpy() for k, v in dataset.labels(index).tensors().items()})
    return sample


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()
