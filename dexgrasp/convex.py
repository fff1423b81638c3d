"""Convex parts of a mesh for physics, by approximate convex decomposition, kept on disk by the mesh's hash."""

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]

VERSION = 1
"""Part of the cache key: raise it when the decomposition changes."""
FACES = 3000
"""The decomposition works on a mesh simplified to this many faces: its time grows with them, its accuracy hardly."""


CHILD = """
import resource, sys
path, seconds = sys.argv[1], int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
import coacd, numpy
stored = dict(numpy.load(path))
coacd.set_log_level("off")
options = eval(sys.argv[3])
parts = coacd.run_coacd(coacd.Mesh(stored["vertices"], stored["faces"]), **options)
points = [numpy.asarray(points, dtype=float) for points, _ in parts]
numpy.savez(path, points=numpy.vstack(points), cuts=numpy.cumsum([len(each) for each in points])[:-1])
"""
"""A decomposition in a process of its own, which can be ended: `path` of an npz, seconds of processor time, options."""


class Slow(Exception):
    """A decomposition that took longer than it may."""


def cache_folder() -> Path:
    """Where derived data of meshes are kept: ``$DEXGRASP_CACHE``, else ``~/.cache/dexgrasp``."""
    return Path(os.environ.get("DEXGRASP_CACHE") or Path.home() / ".cache" / "dexgrasp")


def mesh_hash(mesh: trimesh.Trimesh) -> str:
    """Hash of the vertices and faces as they stand."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()


def convex_parts(
    mesh: trimesh.Trimesh, threshold: float = 0.005, seconds: int | None = None
) -> tuple[trimesh.Trimesh, ...]:
    """Return convex bodies (m, at most 64 vertices each) that cover a watertight mesh (Wei et al. 2022, CoACD).

    `threshold` (m) is twice the depth of the dents that a part may fill, nearly; at least 2 % of the extent is taken.
    A mesh that fills 97 % of its hull is one part. The result is cached; same mesh and threshold, same parts.
    Raises Slow after so many `seconds` of processor time; None waits.
    """
    key = f"{mesh_hash(mesh)}-{threshold:g}-{FACES}-v{VERSION}"
    path = cache_folder() / "convex" / f"{key}.npz"
    found = _read(path)
    if found is None:
        found = _decompose(mesh, threshold, seconds)
        _write(path, found)
    return tuple(trimesh.convex.convex_hull(points) for points in found)


def _decompose(mesh: trimesh.Trimesh, threshold: float, seconds: int | None) -> list[Array]:
    hull = mesh.convex_hull
    if mesh.is_watertight and mesh.volume > 0.97 * hull.volume:
        return [_at_most_64(np.asarray(hull.vertices))]
    vertices, faces = _simplified(mesh)
    depth = max(threshold, 0.02 * float(mesh.extents.max()))
    options: dict[str, Any] = {"threshold": depth, "real_metric": True, "seed": 0, "resolution": 500,
               "mcts_iterations": 15, "mcts_nodes": 8, "mcts_max_depth": 2}  # fmt: skip
    if seconds is not None:
        return [_at_most_64(points) for points in _limited(vertices, faces, options, seconds) if len(points) > 3]
    import coacd  # loads a large library: only when a mesh is not in the cache

    coacd.set_log_level("error")
    parts = coacd.run_coacd(coacd.Mesh(vertices, faces), **options)
    return [_at_most_64(np.asarray(points, dtype=float)) for points, _ in parts if len(points) > 3]


def _limited(vertices: Array, faces: NDArray[np.int32], options: dict[str, Any], seconds: int) -> list[Array]:
    """Return the points of each part; raises Slow where that is not done in time, or broke."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "mesh.npz")
        np.savez(path, vertices=vertices, faces=faces)
        command = [sys.executable, "-c", CHILD, path, str(seconds), repr(options)]
        if subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode:
            raise Slow
        with np.load(path) as stored:
            return np.split(stored["points"], stored["cuts"])


def _simplified(mesh: trimesh.Trimesh) -> tuple[Array, NDArray[np.int32]]:
    import fast_simplification

    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int32)
    if len(faces) <= FACES:
        return vertices, faces
    less, fewer = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=FACES)
    small = trimesh.Trimesh(less.astype(float), fewer, process=False)
    # Simplification may tear thin walls: then the mesh as it is.
    if not small.is_watertight or abs(small.volume - mesh.volume) > 0.05 * mesh.volume:
        return vertices, faces
    return np.asarray(small.vertices), np.asarray(small.faces, dtype=np.int32)


def _at_most_64(points: Array) -> Array:
    import manifold3d

    from dexgrasp.shapes.solid import reduced

    return reduced(manifold3d.Manifold.hull_points(points))


def _read(path: Path) -> list[Array] | None:
    try:
        with np.load(path, allow_pickle=False) as stored:
            return np.split(stored["points"], stored["cuts"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None  # absent, or cut off by a crash: made again


def _write(path: Path, parts: list[Array]) -> None:
    """Several workers may write one key: each writes its own file and renames it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".tmp", delete=False) as file:
        np.savez(file, points=np.vstack(parts), cuts=np.cumsum([len(part) for part in parts])[:-1])
    os.replace(file.name, path)


def deviation(mesh: trimesh.Trimesh, parts: tuple[trimesh.Trimesh, ...], samples: int = 2000) -> tuple[Array, Array]:
    """How far the parts' union leaves the mesh (m): at surface points, outside the parts (S,) and deep inside (S,).

    Distances are to the nearest part's facet planes: exact inside a part, a lower bound outside.
    """
    points, _ = trimesh.sample.sample_surface(mesh, samples, seed=0)
    signed = np.full(len(points), np.inf)
    for part in parts:
        offset = np.einsum("ij,ij->i", part.face_normals, part.triangles[:, 0])
        signed = np.minimum(signed, (points @ part.face_normals.T - offset).max(axis=1))
    return np.maximum(signed, 0), np.maximum(-signed, 0)
