"""A URDF as a `Model`; what is broken but plain to mend is mended and noted."""

import difflib
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Inertia, Joint, Link, Mimic, Model, Shape
from dexgrasp.urdf_geometry import numbers

KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}
KINDS |= {"floating": "floating", "planar": "floating"}


def read_urdf(path: Path, robot: ElementTree.Element, guesses: Guesses) -> Model:
    """Return a URDF as a model; mesh files are not read yet.

    Raises DexgraspError for what cannot be understood.
    """
    if any("xacro" in element.tag for element in robot.iter()):
        remedy = f"expand it first: xacro {path.name} > {path.name.partition('.')[0]}.urdf"
        raise DexgraspError("a URDF", f"xacro macros in {path}", remedy)
    links = [_link(element, path) for element in robot.findall("link")]
    joints = [_joint(element, path) for element in robot.findall("joint")]
    if not links:
        raise DexgraspError(f"links in {path}", "none", "name another file")
    _mend_mimics(joints, path, guesses)
    return Model(robot.get("name") or path.stem, path, links, joints)


def _link(element: ElementTree.Element, path: Path) -> Link:
    name = element.get("name", "")
    link = Link(name, *([_shape(e, name, path) for e in element.findall(tag)] for tag in ("visual", "collision")))  # type: ignore[arg-type]
    link.visuals = [shape for shape in link.visuals if shape is not None]
    link.collisions = [shape for shape in link.collisions if shape is not None]
    inertial = element.find("inertial")
    if inertial is not None and inertial.find("mass") is not None:
        frame = _origin(inertial.find("origin"))
        tag = inertial.find("inertia")
        xx, xy, xz, yy, yz, zz = (
            float(numbers(tag, key, "0", 1)[0]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        mass = float(numbers(inertial.find("mass"), "value", "0", 1)[0])
        link.inertia = Inertia(mass, frame[:3, 3], frame[:3, :3] @ moments @ frame[:3, :3].T)
    return link


def _shape(element: ElementTree.Element, link: str, path: Path) -> Shape | None:
    geometry = element.find("geometry")
    if geometry is None or len(geometry) == 0:
        return None
    origin, tag = _origin(element.find("origin")), geometry[0]
    if tag.tag == "mesh":
        scale = tag.get("scale", "1 1 1")
        return Shape(origin, numbers(tag, "scale", "1 1 1", len(scale.split())) * np.ones(3), tag.get("filename", ""))
    if tag.tag == "box":
        return Shape(origin, mesh=trimesh.creation.box(numbers(tag, "size", "")))
    if tag.tag == "sphere":
        return Shape(origin, mesh=trimesh.creation.icosphere(3, float(numbers(tag, "radius", "", 1)[0])))
    if tag.tag in ("cylinder", "capsule"):
        radius, length = (float(numbers(tag, key, "", 1)[0]) for key in ("radius", "length"))
        if tag.tag == "cylinder":
            return Shape(origin, mesh=trimesh.creation.cylinder(radius, length, sections=32))
        return Shape(origin, mesh=capsule(radius, length))
    raise DexgraspError(
        "box, cylinder, capsule, sphere or mesh geometry", f"<{tag.tag}> in link {link!r} of {path}", "replace it"
    )


def capsule(radius: float, length: float) -> trimesh.Trimesh:
    """Return a capsule about the origin along z; `length` without its caps (m)."""
    ends = []
    for side in (-1, 1):
        ball = trimesh.creation.icosphere(3, radius)
        ball.apply_translation([0, 0, side * length / 2])
        ends.append(ball.vertices)
    return trimesh.convex.convex_hull(np.vstack(ends))


def _origin(element: ElementTree.Element | None) -> np.ndarray:
    roll, pitch, yaw = numbers(element, "rpy", "0 0 0")
    matrix = trimesh.transformations.euler_matrix(roll, pitch, yaw, "sxyz")
    matrix[:3, 3] = numbers(element, "xyz", "0 0 0")
    return matrix


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    if kind not in KINDS:
        raise DexgraspError(
            f"joint {name!r} to be one of {', '.join(KINDS)}", f"{kind!r} in {path}", "correct its type"
        )
    ends = [element.find(end) for end in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    axis = numbers(element.find("axis"), "xyz", "1 0 0")
    length = float(np.linalg.norm(axis))
    if length < 1e-9 and KINDS[kind] in ("revolute", "prismatic"):
        raise DexgraspError(f"an axis of joint {name!r}", f"{axis} in {path}", "write which way it moves")
    joint = Joint(name, KINDS[kind], parent, child, _origin(element.find("origin")), axis / max(length, 1e-9))
    limit = element.find("limit")
    if limit is not None:
        given = {key: _number(limit, key) for key in ("lower", "upper", "effort", "velocity")}
        if kind != "continuous" and {"lower", "upper"} & limit.attrib.keys():
            # The standard has 0 where one of the two is left out.
            joint.lower = given["lower"] if "lower" in limit.attrib else 0.0
            joint.upper = given["upper"] if "upper" in limit.attrib else 0.0
        joint.effort, joint.velocity = given["effort"], given["velocity"]
    mimic = element.find("mimic")
    if mimic is not None and joint.moves:
        rate, offset = (float(numbers(mimic, k, d, 1)[0]) for k, d in (("multiplier", "1"), ("offset", "0")))
        joint.mimic = Mimic(mimic.get("joint", ""), rate, offset)
    return joint


def _number(element: ElementTree.Element, key: str) -> float:
    try:
        return float(element.get(key, "nan"))
    except ValueError:
        return math.nan


def _mend_mimics(joints: list[Joint], path: Path, guesses: Guesses) -> None:
    """Point couplings at joints that exist and move, and end circles."""
    known = {joint.name: joint for joint in joints if joint.moves}
    for joint in joints:
        if joint.mimic is None:
            continue
        target = joint.mimic.joint
        if target not in known:
            found = _meant(joint.name, target, list(known))
            if found is None:
                close = difflib.get_close_matches(target, list(known), n=1)
                hint = f"did you mean {close[0]!r}? " if close else ""
                raise DexgraspError(
                    f"a movable joint for {joint.name!r} to mimic",
                    f"{target!r} in {path}, which is none",
                    f"{hint}correct the <mimic> tag",
                )
            guesses.add("couplings", f"{joint.name} mimics {target!r}, which is none; {found} is meant", "likely")
            joint.mimic.joint = found
        seen, at = {joint.name}, known[joint.mimic.joint]
        while at.mimic is not None and at.mimic.joint in known:
            if at.name in seen:
                raise DexgraspError(
                    "couplings with an end", f"a circle through {at.name!r} in {path}", "correct <mimic>"
                )
            seen.add(at.name)
            at = known[at.mimic.joint]


def _meant(joint: str, target: str, known: list[str]) -> str | None:
    """Return the joint that a name without its prefix means: that which shares most of the mimic joint's own."""
    ends = [name for name in known if name != joint and name.endswith(target)] if target else []
    shared = [len(_common(name, joint)) for name in ends]
    best = [name for name, count in zip(ends, shared, strict=True) if count == max(shared)]
    return best[0] if len(best) == 1 else None


def _common(a: str, b: str) -> str:
    return a[: next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))]
