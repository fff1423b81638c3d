"""A URDF as XML: read, cut down to the hand, checked; numbers of its joints and links."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pinocchio as pin
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.urdf_geometry import numbers


class UrdfFile:
    """The part of a URDF below `root` (default: all of it). Every error names the file.

    `couplings`, `limits` and `efforts` replace what the file says of some joints, see `UrdfHand`.
    """

    def __init__(
        self,
        path: Path,
        root: str | None = None,
        couplings: Mapping[str, Mapping[str, Any] | None] | None = None,
        limits: Mapping[str, Sequence[float]] | None = None,
        efforts: Mapping[str, float] | None = None,
    ) -> None:
        self.path = path
        self.robot = read_robot(path, root)
        self.joints = {joint.get("name", ""): joint for joint in self.robot.findall("joint")}
        for name, coupling in (couplings or {}).items():
            self._couple(self._joint(name, "couplings"), coupling)
        for name, ends in (limits or {}).items():
            joint = self._joint(name, "limits")
            joint.set("type", "revolute" if joint.get("type") == "continuous" else joint.get("type", ""))
            _limit(joint).attrib.update(zip(("lower", "upper"), map(str, ends), strict=False))
        for name, effort in (efforts or {}).items():
            _limit(self._joint(name, "efforts")).set("effort", str(effort))
        for joint in self.joints.values():
            if joint.get("type") == "continuous":
                _bound(joint)
        # Before Pinocchio, which says of bad numbers only that there are some.
        self._check_mimics()
        for name, joint in self.joints.items():
            if joint.get("type") in ("revolute", "prismatic") and joint.find("mimic") is None:
                self.limits(name)

    def model(self) -> pin.Model:
        """Return the Pinocchio model; mimic joints are ordinary ones there."""
        try:
            return pin.buildModelFromXML(ElementTree.tostring(self.robot, encoding="unicode"))
        except Exception as error:
            raise DexgraspError(
                "a URDF that Pinocchio can read", f"{self.path}: {error}", "check parents, children and numbers"
            ) from error

    def free(self, movable: tuple[str, ...]) -> tuple[str, ...]:
        """Return those movable joints that mimic none, in the file's order."""
        return tuple(name for name, joint in self.joints.items() if name in movable and joint.find("mimic") is None)

    def coupling(
        self, movable: tuple[str, ...], free: tuple[str, ...]
    ) -> tuple[Float[Tensor, "M J"], Float[Tensor, "M"]]:
        """Return (A, b) with movable = A free + b, from the `<mimic>` tags."""
        matrix = torch.zeros(len(movable), len(free), dtype=torch.float64)
        offset = torch.zeros(len(movable), dtype=torch.float64)
        for row, name in enumerate(movable):
            rate, shift, joint = 1.0, 0.0, name
            while (mimic := self.joints[joint].find("mimic")) is not None:
                shift += rate * float(numbers(mimic, "offset", "0", 1)[0])
                rate *= float(numbers(mimic, "multiplier", "1", 1)[0])
                joint = mimic.get("joint", "")
            matrix[row, free.index(joint)] = rate
            offset[row] = shift
        return matrix, offset

    def limits(self, joint: str) -> tuple[float, float]:
        """Return lower and upper limit (rad or m) of a joint."""
        element = self.joints[joint].find("limit")
        values = _value(element, "lower"), _value(element, "upper")
        if not all(map(math.isfinite, values)) or values[0] > values[1]:
            raise DexgraspError(
                f"finite limits, lower <= upper, of joint {joint!r}",
                f"lower {values[0]}, upper {values[1]} in {self.path}",
                "correct its <limit> tag",
            )
        return values

    def effort(self, joint: str) -> float:
        """Return the effort limit (N m or N) of a joint."""
        effort = _value(self.joints[joint].find("limit"), "effort")
        if not 0 < effort < math.inf:
            raise DexgraspError(
                f"an effort limit above 0 (N m or N) of joint {joint!r}",
                f"{effort} in {self.path}",
                "write the real one: tip force times lever arm",
            )
        return effort

    def masses(self) -> dict[str, float]:
        """Return the mass of each link, kg; 0 where none is given."""
        tags = {link.get("name", ""): link.find("inertial/mass") for link in self.robot.findall("link")}
        return {link: 0.0 if tag is None else float(numbers(tag, "value", "", 1)[0]) for link, tag in tags.items()}

    def _joint(self, name: str, key: str) -> ElementTree.Element:
        if name not in self.joints:
            raise DexgraspError(
                f"a joint of {self.path} under `{key}`: {', '.join(self.joints)}", repr(name), "correct the hand's YAML"
            )
        return self.joints[name]

    def _couple(self, joint: ElementTree.Element, coupling: Mapping[str, Any] | None) -> None:
        """Give a joint that `<mimic>` tag, in place of its own; None frees it."""
        for old in joint.findall("mimic"):
            joint.remove(old)
        if coupling is None:
            return
        strange = sorted(set(coupling) - {"joint", "multiplier", "offset"})
        if strange or "joint" not in coupling:
            raise DexgraspError(
                f"joint, multiplier, offset of the coupling of {joint.get('name')!r}",
                ", ".join(strange) or "no joint",
                "correct `couplings` in the hand's YAML",
            )
        ElementTree.SubElement(joint, "mimic", {key: str(value) for key, value in coupling.items()})

    def _check_mimics(self) -> None:
        for name, joint in self.joints.items():
            mimic, seen = joint.find("mimic"), {name}
            while mimic is not None:
                target = mimic.get("joint", "")
                if target not in self.joints or target in seen or self.joints[target].get("type") == "fixed":
                    kind = "a circle through" if target in seen else "a fixed" if target in self.joints else "no"
                    alike = [joint for joint in self.joints if kind == "no" and joint.endswith(target)]
                    hint = f" (it may mean {alike[0]!r})" if len(alike) == 1 else ""
                    raise DexgraspError(
                        f"a movable joint for {name!r} to mimic",
                        f"{kind} joint {target!r} in {self.path}{hint}",
                        "correct the <mimic> tag, or say it right under `couplings` in the hand's YAML",
                    )
                numbers(mimic, "multiplier", "1", 1), numbers(mimic, "offset", "0", 1)
                seen.add(target)
                mimic = self.joints[target].find("mimic")


def read_robot(path: Path, root: str | None = None) -> ElementTree.Element:
    """Return the `<robot>` of a URDF, below the link `root` (default: all of it); its numbers are not looked at."""
    robot = _parse(path)
    names = [link.get("name", "") for link in robot.findall("link")]
    if root is None:
        return robot
    if root not in names:
        raise DexgraspError(f"a link of {path} as `root`", repr(root), f"name one of {', '.join(names)}")
    joints, below = robot.findall("joint"), {root}
    while grown := {_end(joint, "child") for joint in joints if _end(joint, "parent") in below} - below:
        below |= grown
    for link in [link for link in robot.findall("link") if link.get("name") not in below]:
        robot.remove(link)
    for joint in [joint for joint in joints if _end(joint, "parent") not in below]:
        robot.remove(joint)
    return robot


def _parse(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise DexgraspError("a URDF file", f"no file {path}", "correct `urdf` in the hand's YAML")
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise DexgraspError("well-formed XML", f"{path}: {error}", "the file may be cut off: copy it again") from error
    if robot.tag != "robot" or robot.find("link") is None:
        raise DexgraspError("a URDF: <robot> with links", f"<{robot.tag}> in {path}", "name another file")
    return robot


def _bound(joint: ElementTree.Element) -> None:
    """Give a continuous joint one turn, -pi..pi: then each joint is one number, in Pinocchio too."""
    joint.set("type", "revolute")
    limit = _limit(joint)
    limit.set("lower", repr(-math.pi))
    limit.set("upper", repr(math.pi))


def _limit(joint: ElementTree.Element) -> ElementTree.Element:
    """Return the <limit> tag of a joint, a new one where it has none."""
    limit = joint.find("limit")
    return ElementTree.SubElement(joint, "limit", effort="0", velocity="0") if limit is None else limit


def _end(joint: ElementTree.Element, end: str) -> str:
    link = joint.find(end)
    return "" if link is None else link.get("link", "")


def _value(element: ElementTree.Element | None, key: str) -> float:
    try:
        return math.nan if element is None else float(element.get(key, 0))
    except ValueError:
        return math.nan
