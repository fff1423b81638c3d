"""Visual and collision geometry of a URDF as trimeshes in link coordinates."""

import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import trimesh

from dexgrasp.convex import convex_parts
from dexgrasp.errors import DexgraspError

DENT = 0.0015
"""A hull that fills dents up to this depth stands for a mesh, m."""
DEPTH = 0.004
"""Where a mesh is cut into convex parts: twice the depth of the dents that these may fill, m."""
logger = logging.getLogger(__name__)

LARGEST_EXTENT = 2.0
"""No hand's link is longer (m): such a mesh is in millimetres."""


def link_meshes(robot: ElementTree.Element, tag: str, urdf: Path) -> dict[str, list[trimesh.Trimesh]]:
    """Return the meshes of each link that has some; `tag` is `visual` or `collision`.

    Raises DexgraspError for a mesh file that is missing, unreadable or in millimetres.
    """
    meshes: dict[str, list[trimesh.Trimesh]] = {}
    for link in robot.findall("link"):
        for element in link.findall(tag):
            geometry = element.find("geometry")
            if geometry is None or len(geometry) == 0:
                continue
            mesh = _shape(geometry[0], urdf, link.get("name", "?"))
            mesh.apply_transform(_origin(element.find("origin")))
            meshes.setdefault(link.get("name", ""), []).append(mesh)
    return meshes


def convex_pieces(
    mesh: trimesh.Trimesh, link: str, depth: float = DEPTH, seconds: int | None = None
) -> tuple[trimesh.Trimesh, ...]:
    """Return a collision mesh as convex parts: itself, its hull where that is as good, else a decomposition (cached).

    A hull is as good where it stands nowhere more than `DENT` off the mesh. `depth` and `seconds` are `convex_parts`'
    threshold and time.
    """
    if mesh.is_convex:
        return (mesh,)
    hull = mesh.convex_hull
    points, _ = trimesh.sample.sample_surface(hull, 1000, seed=0)
    dent = float(trimesh.proximity.closest_point(mesh, points)[1].max())
    if dent <= DENT:
        return (hull,)
    mesh = mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    parts = convex_parts(mesh, depth, seconds)
    logger.info("link %s: its hull would stand %.1f mm off the mesh; %d convex parts", link, 1e3 * dent, len(parts))
    return parts


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return meshes as one."""
    whole = trimesh.util.concatenate(list(meshes))
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def numbers(element: ElementTree.Element | None, key: str, default: str, count: int = 3) -> np.ndarray:
    """Return `count` finite numbers of an attribute of a URDF element."""
    text = default if element is None else element.get(key, default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all():
        tag = "element" if element is None else f"<{element.tag}>"
        raise DexgraspError(f"{count} finite number(s) as {key!r} of {tag}", repr(text), "correct the URDF")
    return values


def _origin(element: ElementTree.Element | None) -> np.ndarray:
    roll, pitch, yaw = numbers(element, "rpy", "0 0 0")
    matrix = trimesh.transformations.euler_matrix(roll, pitch, yaw, "sxyz")
    matrix[:3, 3] = numbers(element, "xyz", "0 0 0")
    return matrix


def _shape(shape: ElementTree.Element, urdf: Path, link: str) -> trimesh.Trimesh:
    if shape.tag == "box":
        return trimesh.creation.box(numbers(shape, "size", ""))
    if shape.tag == "cylinder":
        radius, length = (float(numbers(shape, key, "", 1)[0]) for key in ("radius", "length"))
        return trimesh.creation.cylinder(radius, length, sections=32)
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(2, float(numbers(shape, "radius", "", 1)[0]))
    if shape.tag == "mesh":
        return _mesh(shape, urdf, link)
    raise DexgraspError(
        "box, cylinder, sphere or mesh geometry",
        f"<{shape.tag}> in link {link!r} of {urdf}",
        "replace it by one of these or by a mesh file",
    )


def _mesh(shape: ElementTree.Element, urdf: Path, link: str) -> trimesh.Trimesh:
    path = find_mesh(shape.get("filename", ""), urdf)
    if path is None:
        raise DexgraspError(
            f"the mesh file of link {link!r}",
            f"no file for {shape.get('filename')!r} named in {urdf}",
            "copy it there, or correct the file name in the URDF (relative names count from the URDF's folder)",
        )
    try:
        mesh = load_file(path)
    except Exception as error:
        raise DexgraspError(f"a readable mesh for link {link!r}", f"{path}: {error}", "export it again") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise DexgraspError(f"a mesh with faces for link {link!r}", f"none in {path}", "export it again")
    mesh.apply_scale(numbers(shape, "scale", "1 1 1"))
    if not np.isfinite(mesh.vertices).all() or mesh.extents.max() > LARGEST_EXTENT:
        raise DexgraspError(
            f"the mesh of link {link!r} in metres (at most {LARGEST_EXTENT:g} m long)",
            f"extents of {np.array2string(mesh.extents, precision=4)} m in {path}",
            'it is probably in millimetres: scale it, or write scale="0.001 0.001 0.001" in the URDF',
        )
    return mesh


def load_file(path: Path) -> trimesh.Geometry:
    """Return what a mesh file holds as one mesh; COLLADA's unit counts, as robots' viewers have it."""
    mesh = trimesh.load_mesh(path)
    mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
    if path.suffix.lower() == ".dae":
        with path.open("rb") as file:
            unit = re.search(rb'<unit\b[^>]*\bmeter\s*=\s*"([^"]+)"', file.read(1 << 16))
        if unit and float(unit[1]) != 1.0:
            mesh.apply_scale(float(unit[1]))
    return mesh


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file of a mesh name: relative, absolute, file:// or package://; None if there is none.

    `package://name/rest` is looked up as `name/rest` and as `rest` in every folder above the URDF and in those
    of ROS_PACKAGE_PATH; `%20` and the like as what they stand for, where there is no such file.
    """
    plain = unquote(name)
    return _find(name, urdf) or (_find(plain, urdf) if plain != name else None)


def _find(name: str, urdf: Path) -> Path | None:
    if name.startswith("package://"):
        rest = name.removeprefix("package://")
        inside = rest.partition("/")[2]
        known = [Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
        candidates = [folder / tail for folder in [*urdf.resolve().parents, *known] for tail in (rest, inside)]
    else:
        candidates = [urdf.parent / name.removeprefix("file://")]
    return next((path for path in candidates if path.is_file()), None)
