"""Grasps as Parquet: one row a grasp, and one row for each scene in which it is feasible."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.temporary import temporary
from dexgrasp.errors import DexgraspError
from dexgrasp.progress import track

MEANING = {
    "object": "name of the object",
    "grasp": "number among the object's grasps",
    "position": "of the hand's base in the object's frame, m",
    "rotation": "object_R_base, row by row",
    "joints": "rad (m where prismatic), in the order of the metadata's `joints`",
    "contacts": "of each fingertip in the object's frame: x, y, z, m, finger by finger",
    "normals": "outward of the object there, unit",
    "touching": "whether each finger closes until it touches; the others stay open, their contacts are NaN",
    "finger": "from which the grasp is told",
    "quality": "epsilon (Ferrari and Canny): see the metadata's `quality`",
    "scene": "number of the scene",
    "place": "of the object among the scene's",
    "object_position": "of the object in the world, z up, table at z = 0, m",
    "object_rotation": "world_R_object, row by row",
}
"""Of every column; stored as metadata of its field too."""


def export_parquet(dataset: Dataset, folder: Path) -> list[Path]:
    """Write `grasps.parquet` and, where there are scenes, `scenes.parquet` and `annotations.parquet`.

    An annotation is a feasible grasp: scene, place, object and grasp, which the other two files explain. Each file
    is written beside its place and renamed. Needs pyarrow; raises DexgraspError where it is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError as cause:
        remedy = "pip install 'dexgrasp[export]'"
        raise DexgraspError("the package pyarrow for Parquet", "not installed", remedy) from cause
    folder.mkdir(parents=True, exist_ok=True)
    synthesis = dataset.config["synthesis"]
    metadata = {
        "dataset": str(dataset.config["name"]),
        "hand": str(dataset.hand_config["name"]),
        "joints": ", ".join(dataset.hand.joint_names),
        "units": "m, rad",
        "quality": f"torque about the centre of mass / largest distance to the surface, friction "
        f"{synthesis['friction']}, {synthesis['edges']} cone edges, unit normal forces of the fingers that touch",
        "seed": str(dataset.config["seed"]),
    }
    written = [_write(folder / "grasps.parquet", _grasps(dataset), metadata)]
    if "scenes" in dataset.folders:
        written.append(_write(folder / "scenes.parquet", _scenes(dataset), metadata))
        written.append(_write(folder / "annotations.parquet", _annotations(dataset), metadata))
    return [path for path in written if path is not None]


def _grasps(dataset: Dataset) -> Iterator[dict[str, Any]]:
    for index in track(range(len(dataset.store("grasps"))), "grasps"):
        grasps = dataset.grasps(index)
        count = len(grasps)
        tensors = {name: value.numpy() for name, value in grasps.tensors().items()}
        yield {
            "object": [dataset.objects[index].name] * count,
            "grasp": np.arange(count, dtype=np.int32),
            "position": tensors["pose"][:, :3, 3],
            "rotation": tensors["pose"][:, :3, :3].reshape(count, 9),
            "joints": tensors["joints"],
            "contacts": tensors["contacts"].reshape(count, -1),
            "normals": tensors["normals"].reshape(count, -1),
            "touching": tensors["touching"],
            "finger": tensors["finger"].astype(np.int8),
            "quality": tensors["quality"],
        }


def _scenes(dataset: Dataset) -> Iterator[dict[str, Any]]:
    for index in track(range(dataset.scenes), "scenes"):
        scene = dataset.scene(index)
        poses = scene.poses.double().numpy()
        yield {
            "scene": np.full(len(scene), index, np.int32),
            "place": np.arange(len(scene), dtype=np.int32),
            "object": list(scene.objects),
            "object_position": poses[:, :3, 3],
            "object_rotation": poses[:, :3, :3].reshape(len(scene), 9),
        }


def _annotations(dataset: Dataset) -> Iterator[dict[str, Any]]:
    names = np.array(dataset.objects.names)
    for index in track(range(dataset.scenes), "annotations"):
        tensors = dataset.store("scenes")[index].tensors
        place = tensors["grasp_object"].numpy()
        yield {
            "scene": np.full(len(place), index, np.int32),
            "place": place,
            "object": list(names[tensors["object"][torch.from_numpy(place).long()].numpy()]),
            "grasp": tensors["grasp"].numpy(),
        }


def _write(path: Path, groups: Iterator[dict[str, Any]], metadata: dict[str, str]) -> Path | None:
    """Write groups of rows; None where there is no group."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    unfinished = temporary(path)
    writer = None
    try:
        for group in groups:
            columns = {name: _column(values) for name, values in group.items()}
            if writer is None:
                fields = [pa.field(n, c.type, metadata={"meaning": MEANING[n]}) for n, c in columns.items()]
                schema = pa.schema(fields, metadata=metadata)
                writer = pq.ParquetWriter(unfinished, schema, compression="zstd")
            writer.write_table(pa.table(list(columns.values()), schema=schema))
        if writer is None:
            return None
        writer.close()
        os.replace(unfinished, path)
        return path
    finally:
        unfinished.unlink(missing_ok=True)


def _column(values: Any) -> Any:
    import pyarrow as pa

    if isinstance(values, np.ndarray) and values.ndim == 2:
        flat = pa.array(np.ascontiguousarray(values).ravel())
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return pa.array(values, type=pa.string() if isinstance(values, list) else None)
