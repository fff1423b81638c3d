"""Mesh files of a robot: found under whatever root the names were written for, read, and brought to metres."""

import logging
from itertools import islice
from pathlib import Path

import numpy as np
import trimesh

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Link, Shape
from dexgrasp.urdf_geometry import find_mesh, load_file

LARGEST = 2.0
"""No link of a robot that has a hand is longer, m: such a mesh is in millimetres."""
SMALLEST = 0.004
"""No robot's largest mesh is smaller, m: such meshes were scaled twice."""
NEARBY = 20000
"""Files looked through for one of the right name."""
log = logging.getLogger(__name__)


def locate(name: str, model: Path, folder: Path | None, guesses: Guesses) -> Path | None:
    """Return the file of a mesh name; None where there is none.

    First as `find_mesh` has it, then any end of the name's path below `folder` and below the folders above the model,
    then a file of that name, and of no other of that name, near the model.
    """
    found = find_mesh(name, model)
    if found is not None:
        return found
    parts = [part for part in name.replace("\\", "/").split("://")[-1].split("/") if part not in ("", ".", "..")]
    roots = ([folder] if folder else []) + list(model.resolve().parents)[:6]
    for start in range(len(parts)):
        for root in roots:
            candidate = root.joinpath(*parts[start:])
            if candidate.is_file():
                if start:
                    guesses.add("meshes", f"{name} was taken to be {candidate}: the end of its path", "likely")
                return candidate
    for root in ([folder] if folder else []) + list(model.resolve().parents)[:2]:
        if len(root.parts) < 3:
            break  # not the whole disk
        same = [path for path in islice(root.rglob("*"), NEARBY) if path.name.lower() == parts[-1].lower()]
        if len(same) == 1:
            guesses.add("meshes", f"{name} was taken to be {same[0]}: the only file of that name nearby", "UNSURE")
            return same[0]
    return None


def read_shapes(links: list[Link], model: Path, folder: Path | None, guesses: Guesses) -> None:
    """Read the mesh files of links in place, in metres; shapes without a file that can be read are taken out.

    Raises DexgraspError where a link is left without any shape that it had.
    """
    shapes = [(link, shape) for link in links for shape in (*link.visuals, *link.collisions) if shape.file]
    read: dict[str, trimesh.Trimesh | str] = {}
    for _, shape in shapes:
        if shape.file not in read:
            path = locate(shape.file, model, folder, guesses)
            read[shape.file] = "no such file" if path is None else _read(path)
    for _, shape in shapes:
        mesh = read[shape.file]
        if isinstance(mesh, trimesh.Trimesh):
            shape.mesh = mesh.copy()
            shape.mesh.apply_scale(shape.scale)
    broken = {name: reason for name, reason in read.items() if isinstance(reason, str)}
    for link in links:
        had = link.solid
        link.visuals = [shape for shape in link.visuals if shape.mesh is not None]
        link.collisions = [shape for shape in link.collisions if shape.mesh is not None]
        if had and not link.solid:
            listed = "; ".join(f"{name} ({reason})" for name, reason in list(broken.items())[:5])
            raise DexgraspError(
                f"a mesh for link {link.name!r} that can be read",
                f"{len(broken)} of the {len(read)} mesh files named in {model} cannot: {listed}",
                "say where they are: meshes=<folder above the names' common part>, or copy them beside the model",
            )
    for name, reason in broken.items():
        guesses.add("meshes", f"{name}: {reason}; the link's other shapes stand for it", "UNSURE")
    _to_metres([shape for _, shape in shapes if shape.mesh is not None], guesses)


def placed(shapes: list[Shape]) -> list[trimesh.Trimesh]:
    """Return the meshes of shapes that were read, in link coordinates."""
    meshes = []
    for shape in shapes:
        if shape.mesh is not None:
            mesh = shape.mesh.copy()
            mesh.apply_transform(shape.origin)
            meshes.append(mesh)
    return meshes


def _read(path: Path) -> trimesh.Trimesh | str:
    try:
        mesh = load_file(path)
    except Exception as error:  # each format's reader has its own exceptions
        return f"{path} cannot be read: {type(error).__name__}: {error}"
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        return f"{path} holds no faces"
    if not np.isfinite(mesh.vertices).all():
        return f"{path} has vertices that are no numbers"
    return trimesh.Trimesh(mesh.vertices, mesh.faces)


def _to_metres(shapes: list[Shape], guesses: Guesses) -> None:
    """Scale the files that share a scale together: small ones cannot tell their unit."""
    groups: dict[tuple[float, ...], list[Shape]] = {}
    for shape in shapes:
        groups.setdefault(tuple(np.abs(shape.scale).round(9).tolist()), []).append(shape)
    for scale, group in groups.items():
        size = max(float(shape.mesh.extents.max()) for shape in group if shape.mesh is not None)
        if SMALLEST <= size <= LARGEST:
            continue
        factor = 1e-3 if size > LARGEST else 1e3
        if not SMALLEST <= size * factor <= LARGEST:
            raise DexgraspError(
                "meshes of a robot's size, in metres or millimetres",
                f"the largest with scale {scale} is {size:.3g} m long",
                "correct scale= in the model",
            )
        unit = "they are in millimetres" if factor < 1 else "they are in metres already"
        guesses.add(
            "meshes",
            f"{len(group)} meshes with scale {scale[0]:g} would be up to {size:.3g} m long: {unit}; times {factor:g}",
            "likely",
        )
        for shape in group:
            if shape.mesh is not None:
                shape.mesh.apply_scale(factor)
