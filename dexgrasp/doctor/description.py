"""A hand as its YAML and URDF describe it, before anything is loaded or refused."""

import logging
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import trimesh

from dexgrasp import plugins
from dexgrasp.errors import DexgraspError
from dexgrasp.urdf_file import read_robot
from dexgrasp.urdf_geometry import find_mesh, load_file

log = logging.getLogger(__name__)
PLACES = ("*.yaml", "hand/*.yaml", "conf/hand/*.yaml", "*/conf/hand/*.yaml")
"""Where a folder may keep a hand's YAML."""


@dataclass(frozen=True)
class MeshFile:
    """A mesh that a link names, as the file has it times the URDF's scale."""

    link: str
    tag: str
    """`visual` or `collision`."""
    filename: str
    path: Path | None
    scale: np.ndarray
    mesh: trimesh.Trimesh | None
    problem: str
    """Why there is no mesh."""


class Description:
    """YAML and URDF of a hand; `options` are the YAML's keys, with all `${...}` replaced."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.options = dict(options)
        self.name = str(options["name"])
        self.urdf = Path(str(options["urdf"])).expanduser()
        self.robot: Element = read_robot(self.urdf, options.get("root"))
        self.links = {link.get("name", ""): link for link in self.robot.findall("link")}
        self.joints = {joint.get("name", ""): joint for joint in self.robot.findall("joint")}

    def replaced(self, key: str, joint: str) -> Any:
        """Return the `limits` or `efforts` that the YAML gives a joint in place of the URDF's, else None."""
        return (self.options.get(key) or {}).get(joint)

    def mimic(self, joint: str) -> tuple[str, float, float] | None:
        """Return leader, multiplier and offset of a coupled joint; None for an independent one."""
        tag = self.joints[joint].find("mimic")
        told: Mapping[str, Any] | None = tag.attrib if tag is not None else None
        told = (self.options.get("couplings") or {}).get(joint, told)
        if not told:
            return None
        return str(told.get("joint", "")), float(told.get("multiplier", 1)), float(told.get("offset", 0))

    @cached_property
    def movable(self) -> list[str]:
        """Names of the joints that move."""
        return [name for name, joint in self.joints.items() if joint.get("type") not in ("fixed", None)]

    @cached_property
    def bodies(self) -> dict[str, list[str]]:
        """Links that move as one: the link below a movable joint (or the root) and what is fixed to it."""
        above = {self._end(joint, "child"): name for name, joint in self.joints.items()}
        found: dict[str, list[str]] = {}
        for link in self.links:
            carrier, seen = link, set()
            while carrier in above and above[carrier] not in self.movable and carrier not in seen:
                seen.add(carrier)
                carrier = self._end(self.joints[above[carrier]], "parent")
            found.setdefault(carrier, []).append(link)
        return found

    @cached_property
    def meshes(self) -> list[MeshFile]:
        """Every mesh file of a visual or collision tag, read once."""
        read: dict[Path, trimesh.Trimesh | str] = {}
        found = []
        for link, element in self.links.items():
            for tag in ("visual", "collision"):
                for shape in element.findall(f"{tag}/geometry/mesh"):
                    found.append(self._mesh(link, tag, shape, read))
        return found

    def extent(self, link: str) -> float:
        """Return the length of the longest side of a link's meshes, m; 0 without any."""
        return max((float(m.mesh.extents.max()) for m in self.meshes if m.link == link and m.mesh), default=0.0)

    def has_geometry(self, link: str) -> bool:
        """Whether a link has something to be seen or met."""
        return any(self.links[link].find(f"{tag}/geometry") is not None for tag in ("visual", "collision"))

    @staticmethod
    def _end(joint: Element, end: str) -> str:
        tag = joint.find(end)
        return "" if tag is None else tag.get("link", "")

    def _mesh(self, link: str, tag: str, shape: Element, read: dict[Path, trimesh.Trimesh | str]) -> MeshFile:
        name = shape.get("filename", "")
        path = find_mesh(name, self.urdf)
        try:
            scale = np.array([float(word) for word in shape.get("scale", "1 1 1").split()])
        except ValueError:
            scale = np.ones(3)
        scale = np.broadcast_to(scale, 3) if len(scale) in (1, 3) else np.ones(3)
        if path is None:
            return MeshFile(link, tag, name, None, scale, None, "missing")
        if path not in read:
            read[path] = _read(path)
        known = read[path]
        if isinstance(known, str):
            return MeshFile(link, tag, name, path, scale, None, known)
        mesh = known.copy()
        mesh.vertices = mesh.vertices * scale  # the faces stay as they are: a mirror turns them inside out
        return MeshFile(link, tag, name, path, scale, mesh, "")


def _read(path: Path) -> trimesh.Trimesh | str:
    try:
        mesh = load_file(path)
    except Exception as error:  # each format's reader has its own exceptions
        return f"unreadable ({type(error).__name__}: {error})"
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return "empty: no faces"
    return mesh if np.isfinite(mesh.vertices).all() else "broken: vertices that are no numbers"


def find_yaml(given: str) -> str:
    """Return what `plugins.load_hand` takes: an installed name, or the path of the one YAML in a folder.

    A folder may be a plugin's project, its package, or hold `hand/<name>.yaml`. The package is put on the path, so that
    `${package:...}` finds it though it is not installed. Raises DexgraspError where there is no YAML of a hand, or more
    than one.
    """
    folder = Path(given).expanduser()
    if not folder.is_dir():
        return given
    if given in plugins.names("hand"):
        log.warning("%s is an installed hand, and that is looked at; for the folder of this name: ./%s", given, given)
        return given
    found = next((hits for place in PLACES if (hits := [f for f in sorted(folder.glob(place)) if _tells(f)])), [])
    if len(found) != 1:
        raise DexgraspError(
            f"one YAML of a hand (name, urdf, fingers) in {folder}",
            ", ".join(map(str, found)) or f"none as {', '.join(PLACES)}",
            "name the YAML itself",
        )
    path = found[0].resolve()
    if path.parent.parent.name == "conf":
        package = path.parents[2]
        home = package.parent if (package / "__init__.py").is_file() else package
        sys.path.insert(0, str(home))
    return str(path)


def _tells(path: Path) -> bool:
    try:
        return {"name", "fingers"} <= plugins.read(path).keys()
    except DexgraspError:
        return False
