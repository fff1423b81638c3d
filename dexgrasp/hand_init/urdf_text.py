"""A model as a URDF: the hand alone, lengths in metres, meshes beside it."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from dexgrasp.hand_init.model import Joint, Link, Model


def write_urdf(model: Model, package: Path) -> None:
    """Write `urdf/<name>.urdf` and `meshes/*.stl` below a package's folder."""
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    robot = ElementTree.Element("robot", name=model.name)
    robot.append(ElementTree.Comment(f" Written by `python -m dexgrasp hand init {model.path.name}`. m, kg, rad. "))
    stems: dict[str, str] = {}
    for number, link in enumerate(model.links.values()):
        stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in link.name) or "link"
        stems[link.name] = stem if stem.lower() not in map(str.lower, stems.values()) else f"{stem}_{number}"
        robot.append(_link(link, stems[link.name], package / "meshes"))
    for joint in model.joints.values():
        robot.append(_joint(model, joint))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, encoding="unicode")
    (package / "urdf" / f"{model.name}.urdf").write_text(f'<?xml version="1.0"?>\n{text}\n', encoding="utf-8")


def _link(link: Link, stem: str, folder: Path) -> ElementTree.Element:
    element = ElementTree.Element("link", name=link.name)
    if link.inertia is not None:
        inertial = ElementTree.SubElement(element, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=words(link.inertia.center))
        ElementTree.SubElement(inertial, "mass", value=f"{link.inertia.mass:.6g}")
        moments = link.inertia.moments
        keys = {"xx": (0, 0), "xy": (0, 1), "xz": (0, 2), "yy": (1, 1), "yz": (1, 2), "zz": (2, 2)}
        ElementTree.SubElement(inertial, "inertia", {f"i{key}": f"{moments[at]:.6g}" for key, at in keys.items()})
    bodies = [("visual", f"{stem}.stl", link.visual)] if link.visual is not None else []
    bodies += [("collision", f"{stem}_convex_{number}.stl", part) for number, part in enumerate(link.parts)]
    for tag, name, mesh in bodies:
        _export(mesh, folder / name)
        geometry = ElementTree.SubElement(ElementTree.SubElement(element, tag), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=f"../meshes/{name}")
    return element


def _export(mesh: trimesh.Trimesh, path: Path) -> None:
    path.write_bytes(trimesh.exchange.stl.export_stl(mesh))


def _joint(model: Model, joint: Joint) -> ElementTree.Element:
    element = ElementTree.Element("joint", name=joint.name, type=joint.kind)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=joint.child)
    angles = trimesh.transformations.euler_from_matrix(joint.origin, "sxyz")
    ElementTree.SubElement(element, "origin", xyz=words(joint.origin[:3, 3]), rpy=words(np.array(angles)))
    if not joint.moves:
        return element
    ElementTree.SubElement(element, "axis", xyz=words(joint.axis))
    velocity = joint.velocity if np.isfinite(joint.velocity) and joint.velocity > 0 else 2.0
    effort = joint.effort if np.isfinite(joint.effort) and joint.effort > 0 else 1.0
    limits = {"lower": joint.lower, "upper": joint.upper, "effort": effort, "velocity": velocity}
    ElementTree.SubElement(element, "limit", {key: f"{value:.9g}" for key, value in limits.items()})
    if joint.mimic is not None:
        lead = model.driver(joint.name)
        told = {"joint": lead.joint, "multiplier": f"{lead.rate:.12g}", "offset": f"{lead.offset:.12g}"}
        ElementTree.SubElement(element, "mimic", told)
    return element


def words(vector: np.ndarray) -> str:
    """Return numbers as text, precise to 1e-12."""
    return " ".join(f"{value:.12g}" for value in np.where(np.abs(vector) < 1e-12, 0.0, vector))
