"""Visual and collision geometry of a URDF as trimeshes in link coordinates."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from dexgrasp.errors import DexgraspError

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


def _numbers(text: str | None, default: str) -> np.ndarray:
    return np.array([float(word) for word in (text or default).split()])


def _origin(element: ElementTree.Element | None) -> np.ndarray:
    if element is None:
        return np.eye(4)
    roll, pitch, yaw = _numbers(element.get("rpy"), "0 0 0")
    matrix = trimesh.transformations.euler_matrix(roll, pitch, yaw, "sxyz")
    matrix[:3, 3] = _numbers(element.get("xyz"), "0 0 0")
    return matrix


def _shape(shape: ElementTree.Element, urdf: Path, link: str) -> trimesh.Trimesh:
    if shape.tag == "box":
        return trimesh.creation.box(_numbers(shape.get("size"), ""))
    if shape.tag == "cylinder":
        return trimesh.creation.cylinder(float(shape.get("radius", 0)), float(shape.get("length", 0)), sections=32)
    if shape.tag == "sphere":
        return trimesh.creation.icosphere(2, float(shape.get("radius", 0)))
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
        mesh = trimesh.load_mesh(path)
    except Exception as error:
        raise DexgraspError(f"a readable mesh for link {link!r}", f"{path}: {error}", "export it again") from error
    mesh = mesh.to_mesh() if isinstance(mesh, trimesh.Scene) else mesh
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise DexgraspError(f"a mesh with faces for link {link!r}", f"none in {path}", "export it again")
    mesh.apply_scale(_numbers(shape.get("scale"), "1 1 1"))
    if not np.isfinite(mesh.vertices).all() or mesh.extents.max() > LARGEST_EXTENT:
        raise DexgraspError(
            f"the mesh of link {link!r} in metres (at most {LARGEST_EXTENT:g} m long)",
            f"extents of {np.array2string(mesh.extents, precision=4)} m in {path}",
            'it is probably in millimetres: scale it, or write scale="0.001 0.001 0.001" in the URDF',
        )
    return mesh


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file of a mesh name: relative, absolute, file:// or package://; None if there is none.

    `package://name/rest` is looked up as `name/rest` and as `rest` in every folder above the URDF.
    """
    if name.startswith("package://"):
        rest = name.removeprefix("package://")
        inside = rest.partition("/")[2]
        candidates = [folder / tail for folder in urdf.resolve().parents for tail in (rest, inside)]
    else:
        candidates = [urdf.parent / name.removeprefix("file://")]
    return next((path for path in candidates if path.is_file()), None)
