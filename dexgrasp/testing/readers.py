"""Every reader of foreign files, each with good inputs: for fuzzing."""

import contextlib
import io
import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexgrasp.checkpoint import read_tensors, write_tensors
from dexgrasp.cloud_file import parse
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.store import MANIFEST, Store
from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Told
from dexgrasp.interchange.formats import named
from dexgrasp.interchange.grasp_set import GraspSet, Posture
from dexgrasp.sensing.intrinsics import Intrinsics, read_intrinsics
from dexgrasp.sensing.mask import read_mask
from dexgrasp.sensing.rigid import read_rigids

Reader = Callable[[bytes, Path], Any]
CAMERA = Intrinsics(100.0, 100.0, 8.0, 8.0)
TOLD = Told(joints=("a", "b"), units=("m", "rad"), robot="hand", object="thing", scale=1.0)


def attempt(reader: Reader, content: bytes, folder: Path) -> None:
    """Give a reader an input in an empty folder; what is neither data nor `DexgraspError` is raised."""
    with contextlib.suppress(DexgraspError):
        reader(content, folder)


def _cloud(kind: str) -> Reader:
    return lambda content, folder: parse(content, kind, "input", None, CAMERA)


def _file(name: str, read: Callable[[Path], Any]) -> Reader:
    def run(content: bytes, folder: Path) -> Any:
        (folder / name).write_bytes(content)
        return read(folder / name)

    return run


def _format(name: str, kind: str) -> Reader:
    def run(path: Path) -> Any:
        named(name).recognises(path)
        return named(name).read(path, TOLD)

    return _file(f"input{kind}", run)


def _manifest(content: bytes, folder: Path) -> Any:
    _store(folder)
    (folder / MANIFEST).write_bytes(content)
    return [item for item in Store.open(folder) for _ in item.tensors]


def _shard(content: bytes, folder: Path) -> Any:
    """A shard whose manifest says that it is as it should be."""
    _store(folder)
    manifest = json.loads((folder / MANIFEST).read_text())
    record = manifest["shards"]["0"]
    (folder / record["file"]).write_bytes(content)
    record |= {"sha256": sha256(content).hexdigest(), "bytes": len(content)}
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return list(Store.open(folder))


def _store(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()
    store = Store.create(folder, "test", {"a": 1}, 0, 1)
    store.add(0, store.write_shard(0, [Item("one", {"x": torch.arange(6.0)}, {"name": "thing"})]))
    store.finish()


def _npy(array: Any, pickled: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=pickled)
    return buffer.getvalue()


def _npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _png(array: Any) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


POINTS = np.random.default_rng(0).uniform(-0.2, 0.6, (40, 3)).astype(np.float32)
DEPTH = np.random.default_rng(0).integers(500, 900, (20, 20)).astype(np.uint16)


def _pcds() -> list[bytes]:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 8\nHEIGHT 5\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA "
    text = "\n".join(" ".join(map(str, row)) for row in POINTS)
    plain = np.ascontiguousarray(POINTS.T).tobytes()
    packed = b"".join(bytes([15]) + plain[at : at + 16] for at in range(0, len(plain), 16))
    packed = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    return [
        f"{head}ascii\n{text}\n".encode(),
        f"{head}binary\n".encode() + POINTS.tobytes(),
        f"{head}binary_compressed\n".encode() + packed,
    ]


def _plys() -> list[bytes]:
    made = []
    for form, order in (("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")):
        head = f"ply\nformat {form} 1.0\nelement vertex 40\nproperty float x\nproperty float y\nproperty float z\n"
        head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        text = "\n".join(" ".join(map(str, row)) for row in POINTS) + "\n3 0 1 2\n"
        made.append(head.encode() + (POINTS.astype(f"{order}f4").tobytes() if order else text.encode()))
    return made


def _written(name: str, kind: str) -> list[bytes]:
    import tempfile

    pose = np.tile(np.eye(4), (2, 1, 1))
    posture = Posture(pose, np.full((2, 2), 0.5))
    grasps = GraspSet("hand", ("a", "b"), ("thing", "thing"), posture, np.ones(2), np.array([0.1, 0.2]))
    with tempfile.TemporaryDirectory() as folder:
        path = named(name).write(grasps, Path(folder) / f"grasps{kind}")
        files = [path] if path.is_file() else sorted(path.rglob(f"*{kind}"))
        return [file.read_bytes() for file in files]


def _dexgraspnet() -> list[dict[str, Any]]:
    places = {f"WRJ{kind}{axis}": 0.1 for kind in "TR" for axis in "xyz"}
    return [{"qpos": {"a": 0.1, "b": 0.2, **places}, "scale": 0.06}]


WORLD = b"""<?xml version="1.0" ?><world><graspableBody><filename>models/thing.xml</filename><transform><fullTransform>
(+1 +0 +0 +0)[+0 +0 +0]</fullTransform></transform></graspableBody><robot><filename>models/hand.xml</filename>
<dofValues>+0.1 +0.2</dofValues><transform><fullTransform>(+1 +0 +0 +0)[+0 +0 +90]</fullTransform></transform></robot>
</world>"""


def _multidex() -> list[bytes]:
    buffer = io.BytesIO()
    torch.save({"metadata": [(torch.zeros(8), "set+thing", "hand")]}, buffer)
    return [buffer.getvalue()]


def _checkpoint() -> list[bytes]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        write_tensors(path, {"x": torch.ones(3)}, {"kind": "model", "config": {}, "points": 64})
        return [path.read_bytes()]


def _stores(name: str) -> list[bytes]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        _store(Path(folder))
        return [next(Path(folder).glob(name)).read_bytes()]


_JSON = [
    json.dumps(each).encode() for each in ({"fx": 1e2, "fy": 1e2, "cx": 1, "cy": 1}, {"K": [9.0] * 9}, [1, 2, 3, 4])
]
_ROS = [
    b"image_width: 20\nimage_height: 20\nk: [100.0, 0, 8, 0, 100, 8, 0, 0, 1]\np: [0.0]\n",
    b"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [1e+2, 0, 8, 0, 100., 8, 0, 0, 1]\n",
]
_POSES = [b"1 0 0 0\n0 1 0 0\n0 0 1 0.5\n0 0 0 1\n", b"0.1 0.2 0.3 1 0 0 0\n"]
_ISAAC = b"""format: isaac_grasp
format_version: 1.0
object_frame: thing
gripper_frame: hand
grasps:
  one:
    confidence: 0.5
    position: [0.1, 0.2, 0.3]
    orientation: {w: 1.0, xyz: [0.0, 0.0, 0.0]}
    cspace_position: {a: 0.1, b: 0.2}
"""

READERS: dict[str, tuple[Reader, Callable[[], list[bytes]]]] = {
    "ply": (_cloud(".ply"), _plys),
    "pcd": (_cloud(".pcd"), _pcds),
    "xyz": (_cloud(".xyz"), lambda: [b"0 0 1\n0.1 0.2 1\n", b"0 0 1 0 0 1\n"]),
    "npy": (_cloud(".npy"), lambda: [_npy(POINTS), _npy(DEPTH), _npy(POINTS.reshape(8, 5, 3))]),
    "npz": (_cloud(".npz"), lambda: [_npz(points=POINTS, normals=POINTS), _npz(depth_mm=DEPTH, K=np.eye(3))]),
    "png": (_cloud(".png"), lambda: [_png(DEPTH)]),
    "mask": (_file("mask.png", read_mask), lambda: [_png((DEPTH > 700).astype(np.uint8))]),
    "intrinsics_json": (_file("k.json", read_intrinsics), lambda: _JSON),
    "intrinsics_yaml": (_file("k.yaml", read_intrinsics), lambda: _ROS),
    "poses_text": (_file("p.txt", lambda path: read_rigids(str(path), "poses")), lambda: _POSES),
    "poses_json": (
        _file("p.json", lambda path: read_rigids(str(path), "poses")),
        lambda: [json.dumps({"poses": np.eye(4)[None].tolist()}).encode(), b"[0,0,0,1,0,0,0]"],
    ),
    "isaac": (_format("isaac", ".yaml"), lambda: [_ISAAC]),
    "dexgrasp": (_format("dexgrasp", ".safetensors"), lambda: _written("dexgrasp", ".safetensors")),
    "dexgraspbench": (_format("dexgraspbench", ".npy"), lambda: _written("dexgraspbench", ".npy")),
    "dexgraspnet_npy": (
        _format("dexgraspnet", ".npy"), lambda: [_npy(np.array(_dexgraspnet(), dtype=object), pickled=True)]
    ),
    "dexgraspnet_json": (_format("dexgraspnet", ".json"), lambda: [json.dumps(_dexgraspnet()).encode()]),
    "graspit": (_format("graspit", ".xml"), lambda: [WORLD]),
    "multidex": (_format("multidex", ".pt"), _multidex),
    "checkpoint": (_file("model.safetensors", read_tensors), _checkpoint),
    "manifest": (_manifest, lambda: _stores(MANIFEST)),
    "shard": (_shard, lambda: _stores("*.tar")),
    "description": (
        _file("dataset-x.json", Dataset.open),
        lambda: [b'{"schema": 1, "config": {}, "hand": {}, "representation": null, "stages": {"views": "v"}}'],
    ),
}  # fmt: skip
"""By name: a reader, and what gives good inputs to start from."""
