"""A hand from a URDF and a few lines of YAML."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.fingertip import fit_fingertip
from dexgrasp.hand import Finger, Hand
from dexgrasp.kinematics import KinematicTree, LinkRecord
from dexgrasp.urdf_geometry import link_meshes

VIRTUAL_REACH = 0.03
"""Distance from fingertip centre to the virtual outer joint of a prismatic finger, m."""


class UrdfHand(Hand):
    """A hand described by a URDF; couplings are its `<mimic>` tags.

    Independent joints stand in the order in which the URDF names them. Pinocchio parses the kinematics (mimic joints
    as ordinary ones) and is the oracle; the batched torch kinematics are compiled from its model.

    Args:
        name: the hand's name.
        urdf: path of the URDF.
        fingers: in order, one mapping each: `name`, `link` (distal link) and, where the defaults are not right,
            `closing` ({independent joint: rate}, default 1 for every unshared joint that turns the distal link about
            its own axis), `tip_radius` and `tip_center` (default: fitted from the link's mesh), `closing_axis`,
            `outer_joint` (link coordinates).
        shared: independent joints that are main joints of every finger.
        palm: a link whose frame is the palm frame, or {origin, approach} in the base frame.
        model: nothing but a key that the YAML's `urdf` may be composed from, where a hand comes in several models.

    Raises:
        DexgraspError: a file, link, joint or number that is missing or wrong.
    """

    def __init__(
        self,
        name: str,
        urdf: str | Path,
        fingers: Sequence[Mapping[str, Any]],
        *,
        shared: Sequence[str] = (),
        palm: str | Mapping[str, Sequence[float]] | None = None,
        model: str | None = None,
    ) -> None:
        self.name, self.urdf = name, Path(urdf)
        robot = _parse(self.urdf)
        self._joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
        self._check_mimics()
        self.model = _build_model(self.urdf)
        self.kinematics = KinematicTree(self.model)
        self.tree: tuple[LinkRecord, ...] = self.kinematics.records
        self.link_names = self.kinematics.names
        self.full_joint_names = tuple(self.model.names[1:])
        self.joint_names = tuple(
            joint for joint, element in self._joints.items() if joint in self.full_joint_names and _free(element)
        )
        self.coupling = self._coupling()
        self.limits = torch.tensor([self._limit(joint) for joint in self.joint_names], dtype=torch.float64)
        self.efforts = torch.tensor([self._effort(joint) for joint in self.joint_names], dtype=torch.float64)
        self.masses = {link.get("name", ""): _mass(link) for link in robot.findall("link")}
        visuals = link_meshes(robot, "visual", self.urdf)
        self.visuals = {link: trimesh.util.concatenate(meshes) for link, meshes in visuals.items()}
        collisions = link_meshes(robot, "collision", self.urdf)
        self.collisions = {link: tuple(_convex(mesh) for mesh in meshes) for link, meshes in collisions.items()}
        self._known(shared, self.joint_names, "shared joint")
        self.shared = tuple(joint for joint in self.joint_names if joint in shared)
        self.base_T_palm = self._palm(palm)
        self.fingers = tuple(self._finger(finger) for finger in fingers)

    def link_poses(self, joints: Float[Tensor, "N J"]) -> dict[str, Float[Tensor, "N 4 4"]]:
        """Return base_T_link of every link; differentiable, dtype and device of `joints`."""
        return self.full_link_poses(self.full_joints(joints))

    def full_joints(self, joints: Float[Tensor, "N J"]) -> Float[Tensor, "N M"]:
        """Return all movable joints, coupled ones included: A joints + b."""
        matrix, offset = (part.to(joints) for part in self.coupling)
        return joints @ matrix.T + offset

    def full_link_poses(self, full: Float[Tensor, "N M"]) -> dict[str, Float[Tensor, "N 4 4"]]:
        """Return base_T_link for joint vectors that need not obey the coupling (breakaway)."""
        return self.kinematics.poses(full)

    def _known(self, names: Sequence[str], known: Sequence[str], what: str) -> None:
        for missing in [name for name in names if name not in known]:
            raise DexgraspError(
                f"a {what} of hand {self.name!r}: {', '.join(known)}",
                f"{missing!r}",
                f"correct the name in the hand's YAML, or add it to {self.urdf}",
            )

    def _check_mimics(self) -> None:
        for name, joint in self._joints.items():
            mimic = joint.find("mimic")
            seen = {name}
            while mimic is not None:
                target = mimic.get("joint", "")
                if target not in self._joints or target in seen:
                    raise DexgraspError(
                        f"a movable joint for {name!r} to mimic",
                        f"{'a circle through' if target in seen else 'no joint'} {target!r} in {self.urdf}",
                        "correct the <mimic> tag",
                    )
                seen.add(target)
                mimic = self._joints[target].find("mimic")

    def _coupling(self) -> tuple[Float[Tensor, "M J"], Float[Tensor, "M"]]:
        matrix = torch.zeros(len(self.full_joint_names), len(self.joint_names), dtype=torch.float64)
        offset = torch.zeros(len(self.full_joint_names), dtype=torch.float64)
        for row, name in enumerate(self.full_joint_names):
            rate, shift, joint = 1.0, 0.0, name
            while (mimic := self._joints[joint].find("mimic")) is not None:
                shift += rate * float(mimic.get("offset", 0))
                rate *= float(mimic.get("multiplier", 1))
                joint = mimic.get("joint", "")
            self._known([joint], self.joint_names, "movable joint")
            matrix[row, self.joint_names.index(joint)] = rate
            offset[row] = shift
        return matrix, offset

    def _limit(self, joint: str) -> tuple[float, float]:
        element = self._joints[joint].find("limit")
        if self._joints[joint].get("type") == "continuous":
            return -math.pi, math.pi
        values = (math.nan, math.nan) if element is None else (_value(element, "lower"), _value(element, "upper"))
        if not all(map(math.isfinite, values)) or values[0] > values[1]:
            raise DexgraspError(
                f"finite limits, lower <= upper, of joint {joint!r}",
                f"lower {values[0]}, upper {values[1]} in {self.urdf}",
                "correct its <limit> tag",
            )
        return values

    def _effort(self, joint: str) -> float:
        element = self._joints[joint].find("limit")
        effort = math.nan if element is None else _value(element, "effort")
        if not effort > 0:
            raise DexgraspError(
                f"an effort limit above 0 (N m or N) of joint {joint!r}",
                f"{effort} in {self.urdf}",
                "write the real one: tip force times lever arm",
            )
        return effort

    def _palm(self, palm: str | Mapping[str, Sequence[float]] | None) -> Float[Tensor, "4 4"]:
        if isinstance(palm, str):
            self._known([palm], self.link_names, "link")
            middle = self.limits.mean(dim=1, keepdim=True).T
            return self.link_poses(middle)[palm][0]
        given: Mapping[str, Sequence[float]] = palm or {}
        z = torch.tensor([float(value) for value in given.get("approach", (0, 0, 1))], dtype=torch.float64)
        z = z / z.norm()
        x = torch.eye(3, dtype=torch.float64)[0 if abs(float(z[0])) < 0.9 else 1]
        x = x - (x @ z) * z
        x = x / x.norm()
        frame = torch.eye(4, dtype=torch.float64)
        frame[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
        frame[:3, 3] = torch.tensor([float(value) for value in given.get("origin", (0, 0, 0))])
        return frame

    def _finger(self, given: Mapping[str, Any]) -> Finger:
        link = str(given["link"])
        self._known([link], self.link_names, "link")
        path = self._path(link)
        joints = [record for record in path if record.joint is not None]
        if not joints:
            raise DexgraspError(f"a movable joint above link {link!r}", "none", f"correct the finger in {self.name!r}")
        matrix = self.coupling[0]
        moved = matrix[[record.index for record in joints]].abs().sum(dim=0) > 0
        chain = tuple(name for name, used in zip(self.joint_names, moved.tolist(), strict=True) if used)
        main = tuple(name for name in self.joint_names if name in chain or name in self.shared)
        last_T_link = np.linalg.multi_dot(
            [np.eye(4), np.eye(4), *[record.parent_T_joint for record in path[path.index(joints[-1]) + 1 :]]]
        )
        link_T_last = np.linalg.inv(last_T_link)
        closing = {str(key): float(value) for key, value in (given.get("closing") or {}).items()}
        self._known(list(closing), self.joint_names, "independent joint")
        closing = closing or self._flexion(joints)
        rates = torch.tensor([closing.get(joint, 0.0) for joint in self.joint_names], dtype=torch.float64)
        rate = float(matrix[joints[-1].index] @ rates) or 1.0
        direction = link_T_last[:3, :3] @ joints[-1].axis * np.sign(rate)
        if joints[-1].kind == "revolute":
            origin, axis, distal = link_T_last[:3, 3], direction, None
        else:
            base_T_link = self.link_poses(self.limits.mean(dim=1, keepdim=True).T)[link][0]
            distal = (base_T_link[:3, :3].T @ self.base_T_palm[:3, 2]).numpy()
            distal = distal - (distal @ direction) * direction
            distal /= np.linalg.norm(distal)
            origin, axis = link_T_last[:3, 3], np.cross(distal, direction)
        axis = np.asarray(given.get("closing_axis", axis), dtype=np.float64)
        axis = axis / np.linalg.norm(axis)
        if "tip_center" in given and "tip_radius" in given:
            center, radius = np.asarray(given["tip_center"], dtype=np.float64), float(given["tip_radius"])
        else:
            center, radius = fit_fingertip(self._solid(link), origin, axis, distal)
        if distal is not None:
            # A slide has no closing axis: METHOD section 1 puts a virtual joint behind and outside the pad.
            origin = center - VIRTUAL_REACH * (direction + distal) / math.sqrt(2)
        origin = np.asarray(given.get("outer_joint", origin), dtype=np.float64)
        return Finger(
            name=str(given.get("name", link)),
            link=link,
            tip_radius=radius,
            tip_center=torch.from_numpy(center),
            outer_joint=torch.from_numpy(origin.copy()),
            closing_axis=torch.from_numpy(axis),
            chain=chain,
            main=main,
            supporting=tuple(joint for joint in self.joint_names if joint not in main),
            closing=closing,
        )

    def _path(self, link: str) -> list[LinkRecord]:
        path, number = [], self.link_names.index(link)
        while number >= 0:
            path.append(self.tree[number])
            number = self.tree[number].parent
        return path[::-1]

    def _flexion(self, joints: list[LinkRecord]) -> dict[str, float]:
        """Return the unshared independent joints that move the distal link as its own joint does."""
        poses = self.link_poses(self.limits.mean(dim=1, keepdim=True).T)
        axes = {record.name: poses[record.name][0, :3, :3].numpy() @ record.axis for record in joints}
        last = joints[-1]
        closing = {}
        for record in joints:
            parallel = abs(float(axes[record.name] @ axes[last.name])) > 0.9
            row = self.coupling[0][record.index]
            for joint, rate in zip(self.joint_names, row.tolist(), strict=True):
                if rate and parallel and record.kind == last.kind and joint not in self.shared:
                    closing[joint] = 1.0
        return closing

    def _solid(self, link: str) -> trimesh.Trimesh:
        if link in self.visuals:
            return self.visuals[link]
        if link in self.collisions:
            return trimesh.util.concatenate(self.collisions[link])
        raise DexgraspError(
            f"geometry of link {link!r} to fit the fingertip to",
            "neither visual nor collision",
            "name a link that has some, or give tip_radius and tip_center in the hand's YAML",
        )


def _parse(urdf: Path) -> ElementTree.Element:
    if not urdf.is_file():
        raise DexgraspError("a URDF file", f"no file {urdf}", "correct `urdf` in the hand's YAML")
    try:
        robot = ElementTree.parse(urdf).getroot()
    except ElementTree.ParseError as error:
        raise DexgraspError("well-formed XML", f"{urdf}: {error}", "the file may be cut off: copy it again") from error
    if robot.tag != "robot" or robot.find("link") is None:
        raise DexgraspError("a URDF: <robot> with links", f"<{robot.tag}> in {urdf}", "name another file")
    return robot


def _build_model(urdf: Path) -> pin.Model:
    try:
        return pin.buildModelFromUrdf(str(urdf))
    except Exception as error:
        raise DexgraspError(
            "a URDF that Pinocchio can read", f"{urdf}: {error}", "check parents, children and numbers"
        ) from error


def _free(joint: ElementTree.Element) -> bool:
    return joint.find("mimic") is None


def _value(element: ElementTree.Element, key: str) -> float:
    try:
        return float(element.get(key, 0))
    except ValueError:
        return math.nan


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else _value(mass, "value")


def _convex(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh if mesh.is_convex else mesh.convex_hull
