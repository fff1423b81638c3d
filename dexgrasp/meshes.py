"""Real meshes: reading the folder layouts in use, checking, repairing."""

import fnmatch
import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import joblib
import numpy as np
import trimesh

from dexgrasp.child import in_workers
from dexgrasp.convex import convex_parts
from dexgrasp.errors import DexgraspError
from dexgrasp.objects import Object
from dexgrasp.origins import origins
from dexgrasp.repair import joined, manifold, repaired

log = logging.getLogger(__name__)

SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
SMALLEST, LARGEST = 0.005, 2.0
"""Extents (m) between which a mesh is taken to be in metres."""
LAYOUTS = {
    "ycb": "*/google_16k/textured.obj",
    "graspnet": "[0-9][0-9][0-9]/nontextured.ply",
    "dexgraspnet": "*/coacd/decomposed.obj",
    "shapenet": "*/*/models/model_normalized.obj",
    "partnet": "*/textured_objs",
}
"""Published object sets by how their paths end; `flat` is any folder of mesh files, sub-folders included."""


class Skip(Exception):
    """Why one mesh is left out; the others go on."""


@dataclass(frozen=True)
class Entry:
    """One object to read: its files (several where a set cuts it into pieces) and the scale to metres."""

    name: str
    files: tuple[Path, ...]
    scale: float


def load_folder(
    path: str,
    layout: str = "auto",
    scale: float | None = None,
    include: str | Sequence[str] = "*",
    exclude: str | Sequence[str] = (),
    repair: bool = False,
    count: int | None = None,
    threshold: float = 0.005,
    workers: int = 1,
    suffix: str = "",
) -> tuple[list[Object], list[tuple[str, str]]]:
    """Return the objects of a folder, sorted by name, and those left out with the reason.

    `layout` is one of `LAYOUTS`, flat or auto; `scale` turns file units into metres (default 1; ShapeNet, whose
    meshes have no unit, needs one); `include` and `exclude` are glob patterns of names; `repair` closes meshes that
    are not watertight and reports by how much the surface moved; `threshold` as in `convex_parts`; `workers`
    processes share the work; `suffix` ends every name, so that one folder can be part of a set at several scales.
    Frames are the files'. Source and licence are those of a ``manifest.json`` (`origins`).
    Raises DexgraspError where nothing usable is found.
    """
    root = Path(path).expanduser()
    entries = find_entries(path, layout, scale, include, exclude, count)
    jobs = (joblib.delayed(_load)(entry, repair, threshold) for entry in entries)
    results: list[tuple[str, Object | None, str]] = list(in_workers(jobs, workers))
    known = origins(root)
    objects = []
    for entry, (_, item, _) in zip(entries, results, strict=False):
        if item is not None:
            source, licence = known.get(entry.files[0].resolve(), ("", ""))
            name, source = item.name + suffix, source or item.source
            objects.append(replace(item, name=name, source=source, licence=licence))
    skipped = [(name, note) for name, item, note in results if item is None]
    for name, item, note in results:
        if note:
            log.warning("%s %s: %s", "skipped" if item is None else "mended", name, note)
    if not objects:
        listed = "; ".join(f"{name}: {reason}" for name, reason in skipped[:5])
        raise DexgraspError(f"a usable mesh under {root}", f"{len(skipped)} skipped ({listed})", "mend what is named")
    return objects, skipped


def find_entries(
    path: str,
    layout: str = "auto",
    scale: float | None = None,
    include: str | Sequence[str] = "*",
    exclude: str | Sequence[str] = (),
    count: int | None = None,
) -> list[Entry]:
    """Return what `load_folder` would read with these options; raises DexgraspError where that is nothing."""
    root = Path(path).expanduser()
    entries = find_meshes(root, layout, scale)
    entries = [entry for entry in entries if _matches(entry.name, include) and not _matches(entry.name, exclude)]
    if not entries:
        raise DexgraspError(f"meshes under {root}", "none whose name is included", "change include and exclude")
    return entries[:count]


def find_meshes(root: Path, layout: str = "auto", scale: float | None = None) -> list[Entry]:
    """Return what a folder holds, by its layout, without reading any mesh. Names are unique and sorted."""
    if not root.is_dir():
        raise DexgraspError("a folder of meshes", f"no folder at {root}", "set objects.path")
    choices = [layout] if layout != "auto" else [*LAYOUTS, "flat"]
    if not set(choices) <= {*LAYOUTS, "flat"}:
        raise DexgraspError(f"objects.layout to be auto, flat or one of {list(LAYOUTS)}", repr(layout), "set it so")
    for choice in choices:
        found = _find(root, choice, scale)
        if found:
            return sorted(found, key=lambda entry: entry.name)
    what = f"no file that ends in {', '.join(SUFFIXES)}" if "flat" in choices else f"nothing like {LAYOUTS[layout]}"
    raise DexgraspError(f"meshes ({layout} layout) under {root}", what, "set objects.path and objects.layout")


def _find(root: Path, layout: str, scale: float | None) -> list[Entry]:
    if layout == "flat":
        files = sorted(file for file in root.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
        stems = [file.stem for file in files]
        names = [
            file.stem if stems.count(file.stem) == 1 else "_".join(file.relative_to(root).with_suffix("").parts)
            for file in files
        ]
        names = [
            name if names.count(name) == 1 else name + file.suffix for name, file in zip(names, files, strict=True)
        ]
        return [Entry(name, (file,), scale or 1.0) for name, file in zip(names, files, strict=True)]
    found = sorted(root.rglob(LAYOUTS[layout]))
    if layout == "shapenet":
        if found and scale is None:
            remedy = "set objects.scale to the model's size in metres, e.g. 0.15"
            raise DexgraspError("objects.scale for ShapeNet, whose models are of unit size", "none", remedy)
        return [Entry(f"{f.parents[2].name}_{f.parents[1].name}", (f,), scale or 1.0) for f in found]
    if layout == "partnet":
        pieces = {folder.parent.name: tuple(sorted(folder.glob("*.obj"))) for folder in found}
        return [Entry(name, files, scale or 1.0) for name, files in pieces.items() if files]
    above = {"ycb": 1, "graspnet": 0, "dexgraspnet": 1}[layout]
    return [Entry(f.parents[above].name, (f,), scale or _own_scale(f.parents[above])) for f in found]


def _own_scale(folder: Path) -> float:
    """DexGraspNet's unit-size meshes may carry their scale in a ``scale.json`` beside them; else 1."""
    try:
        return float(json.loads((folder / "scale.json").read_text()))
    except (OSError, ValueError, TypeError):
        return 1.0


def _matches(name: str, patterns: str | Sequence[str]) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in ([patterns] if isinstance(patterns, str) else patterns))


def _load(entry: Entry, repair: bool, threshold: float) -> tuple[str, Object | None, str]:
    """A name, its object, what was mended; without object the reason for leaving it out. Runs in a worker process."""
    source = str(entry.files[0])
    try:
        mesh = read_mesh(entry.files, entry.scale)
        mesh, note = check_mesh(mesh, repair)
        parts = convex_parts(mesh, threshold)
    except Skip as reason:
        return entry.name, None, str(reason)
    except Exception as error:  # coacd and mesh readers raise all sorts; one bad file must not stop the rest
        return entry.name, None, f"{type(error).__name__}: {error}"
    return entry.name, Object(entry.name, entry.name, mesh, parts, f"{source} ({note})" if note else source), note


def read_mesh(files: Iterable[Path], scale: float = 1.0) -> trimesh.Trimesh:
    """Read one mesh (m) from one or more files, joined. Raises Skip where a file cannot be read."""
    pieces = []
    for file in files:
        try:
            piece = trimesh.load(file, force="mesh", process=False, skip_materials=True)
        except Exception as error:  # each format's reader has its own exceptions
            raise Skip(f"cannot be read ({type(error).__name__}: {error}); is the file whole?") from error
        if not isinstance(piece, trimesh.Trimesh) or len(piece.faces) == 0:
            raise Skip("holds no faces; is the file whole?")
        pieces.append(trimesh.Trimesh(piece.vertices, piece.faces, process=False))
    mesh: trimesh.Trimesh = trimesh.util.concatenate(pieces) if len(pieces) > 1 else pieces[0]  # type: ignore[assignment]
    mesh.apply_scale(scale)
    return mesh


def check_mesh(mesh: trimesh.Trimesh, repair: bool = False) -> tuple[trimesh.Trimesh, str]:
    """Return the mesh as a closed body with faces outward, and what was mended ('' for nothing).

    Raises Skip, with the reason: numbers that are not finite, an extent outside 5 mm to 2 m, several separate
    bodies, a surface that is not closed (unless `repair`).
    """
    if not np.isfinite(mesh.vertices).all():
        raise Skip(f"{int((~np.isfinite(mesh.vertices)).any(axis=1).sum())} vertices are NaN or infinite")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise Skip("faces name vertices that are not there; is the file whole?")
    extent = float(mesh.extents.max())
    if not SMALLEST <= extent <= LARGEST:
        guess = next((s for s in (1e-3, 1e-2, 0.0254, 1e3, 1e2) if 0.03 <= extent * s <= 0.6), 0.15 / max(extent, 1e-9))
        raise Skip(f"its extent is {extent:.3g} m, not within 5 mm and 2 m; with objects.scale={guess:.3g} it would be "
                   f"{extent * guess:.3g} m")  # fmt: skip
    mesh = mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces(height=0))
    mesh.remove_unreferenced_vertices()
    notes = []
    if not mesh.is_watertight:
        if not repair:
            raise Skip("not watertight; objects.repair=true closes it and reports the deviation")
        mesh, moved = repaired(mesh)
        if not mesh.is_volume:
            raise Skip("not watertight, and could not be repaired")
        notes.append(f"repaired: surface moved {1e3 * moved:.2f} mm (p95)")
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    if mesh.volume < 0:
        mesh.invert()
        notes.append("turned inside out")
    bodies = mesh.split(only_watertight=False) if mesh.body_count > 1 else [mesh]
    outer = [body for body in bodies if body.volume > 0.01 * mesh.volume]
    if len(outer) > 1:
        if not _touching(outer):
            raise Skip(f"{len(outer)} separate bodies; one rigid body is expected")
        mesh = joined(outer)
        notes.append(f"{len(outer)} overlapping bodies joined")
    if not mesh.is_volume or mesh.volume < 1e-9:
        raise Skip("its surface does not enclose a volume")
    return mesh, ", ".join(notes)


def _touching(bodies: Sequence[trimesh.Trimesh]) -> bool:
    """Whether closed pieces overlap or touch (0.5 mm) so that they make one body."""
    linked, waiting = [bodies[0]], list(bodies[1:])
    while waiting:
        near = [w for w in waiting if any(_near(w, done) for done in linked)]
        if not near:
            return False
        linked += near
        waiting = [w for w in waiting if all(w is not n for n in near)]
    return True


def _near(a: trimesh.Trimesh, b: trimesh.Trimesh, gap: float = 5e-4) -> bool:
    if (a.bounds[0] - gap > b.bounds[1]).any() or (b.bounds[0] - gap > a.bounds[1]).any():
        return False
    first, second = (manifold(body) for body in (a, b))
    return float(first.min_gap(second, 2 * gap)) < gap
