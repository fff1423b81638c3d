"""A robot arm from a URDF and a few lines of YAML: the chain from its base to the flange that carries the hand."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.config import conf_folder
from dexgrasp.errors import DexgraspError
from dexgrasp.kinematics import KinematicTree
from dexgrasp.plugins import construct, read, resolved
from dexgrasp.urdf_file import UrdfFile
from dexgrasp.urdf_geometry import link_meshes


class Arm:
    """The A joints between `root` and `flange`; base frame: `root`. Metres, radians, float64.

    Pinocchio parses the kinematics; `flange_poses` is batched over postures. What hangs on other movable joints or
    below the flange (a gripper that the URDF brings along) is left out.

    Args:
        name: the arm's name.
        urdf: path of the URDF.
        flange: link to which the hand is bolted.
        root: link at which the arm begins; default: the URDF's root.
        home: {joint: value}, a posture in which nothing of the arm collides; default: the middle of the limits. The
            solution nearest to it is taken.
        flange_T_hand: {xyz, rpy} of the hand's base frame in the flange's (m, rad as in a URDF; default: the same).

    Raises:
        DexgraspError: a file, link, joint or number that is missing or wrong.
    """

    def __init__(
        self,
        name: str,
        urdf: str | Path,
        flange: str,
        *,
        root: str | None = None,
        home: Mapping[str, float] | None = None,
        flange_T_hand: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        self.name, self.urdf, self.flange = name, Path(urdf), flange
        file = UrdfFile(self.urdf, root)
        _keep_chain(file, flange)
        self.model = file.model()
        self.kinematics = KinematicTree(self.model)
        self.joint_names = tuple(self.model.names[1:])
        if not self.joint_names:
            raise DexgraspError(f"movable joints between base and {flange!r}", f"none in {urdf}", "correct `flange`")
        self.limits = torch.tensor([file.limits(joint) for joint in self.joint_names], dtype=torch.float64)
        speeds = torch.from_numpy(np.array(self.model.velocityLimit, dtype=np.float64))
        self.speeds = torch.where((speeds > 0) & speeds.isfinite(), speeds, torch.inf)
        """Top speed of each joint, rad/s or m/s; infinite where the URDF gives none."""
        self.home = self._posture(home or {})
        self.flange_T_hand = placement(flange_T_hand or {}, "flange_T_hand")
        self.reach = self._longest()
        """The flange is nowhere farther than this from the base, m: the sum of all lengths."""
        self._hulls: dict[str, tuple[trimesh.Trimesh, ...]] | None = None
        self._robot = file.robot

    @property
    def hulls(self) -> dict[str, tuple[trimesh.Trimesh, ...]]:
        """Convex hull of each collision mesh, by link, link coordinates."""
        if self._hulls is None:
            meshes = link_meshes(self._robot, "collision", self.urdf)
            self._hulls = {link: tuple(mesh.convex_hull for mesh in own) for link, own in meshes.items()}
        return self._hulls

    def link_poses(self, joints: Float[Tensor, "N A"]) -> dict[str, Float[Tensor, "N 4 4"]]:
        """Return base_T_link of every link."""
        return self.kinematics.poses(joints)

    def jacobian(self, joints: Float[Tensor, "N A"]) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N 6 A"]]:
        """Return base_T_flange and its geometric Jacobian: velocity and turning rate in the base's axes."""
        poses = self.kinematics.poses(joints)
        flange = poses[self.flange]
        columns: list[Tensor] = [flange[:, :0, 3]] * len(self.joint_names)
        for record in self.kinematics.records:
            if record.joint is None:
                continue
            pose = poses[record.name]
            axis = pose[:, :3, :3] @ torch.from_numpy(record.axis)
            if record.kind == "prismatic":
                column = torch.cat([axis, torch.zeros_like(axis)], dim=1)
            else:
                column = torch.cat([torch.linalg.cross(axis, flange[:, :3, 3] - pose[:, :3, 3]), axis], dim=1)
            columns[record.index] = column
        return flange, torch.stack(columns, dim=2)

    def _posture(self, home: Mapping[str, float]) -> Float[Tensor, "A"]:
        strange = sorted(set(home) - set(self.joint_names))
        if strange:
            raise DexgraspError(f"joints of {self.name!r} in `home`: {', '.join(self.joint_names)}", strange[0], "mend")
        posture = self.limits.mean(dim=1)
        for row, joint in enumerate(self.joint_names):
            posture[row] = float(home.get(joint, posture[row]))
        if not bool(((posture >= self.limits[:, 0]) & (posture <= self.limits[:, 1])).all()):
            raise DexgraspError(f"`home` of {self.name!r} within limits", f"{posture.tolist()}", "mend the arm's YAML")
        return posture

    def _longest(self) -> float:
        records = {record.name: record for record in self.kinematics.records}
        link, way = records[self.flange], 0.0
        while True:
            way += float(np.linalg.norm(link.parent_T_joint[:3, 3]))
            if link.kind == "prismatic":
                way += float(self.limits[link.index].abs().max())
            if link.parent < 0:
                return way
            link = self.kinematics.records[link.parent]


def load_arm(name: str, **overrides: Any) -> Arm:
    """Return the arm `name` of conf/arm, or that of the YAML file at path `name`; `overrides` replace its keys.

    Raises DexgraspError for an unknown or broken arm.
    """
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser().resolve()
    else:
        path = conf_folder() / "arm" / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in (conf_folder() / "arm").glob("*.yaml")))
        raise DexgraspError(f"an arm ({known}) or the path of a YAML file", repr(name), f"correct it, or write {path}")
    return build_arm(read(path) | overrides)


def build_arm(config: Mapping[str, Any]) -> Arm:
    """Return the arm of a composed config: the arguments of `Arm`."""
    arm = construct(Arm, resolved("arm", config))
    assert isinstance(arm, Arm)
    return arm


def placement(given: Mapping[str, Sequence[float]], what: str) -> Float[Tensor, "4 4"]:
    """Return the (4, 4) of {xyz, rpy} as in a URDF (m; rad about the fixed axes x, y, z), each 0 by default."""
    try:
        xyz, rpy = ([float(value) for value in given.get(key, (0, 0, 0))] for key in ("xyz", "rpy"))
        good = len(xyz) == len(rpy) == 3 and bool(np.isfinite([*xyz, *rpy]).all()) and set(given) <= {"xyz", "rpy"}
    except (AttributeError, TypeError, ValueError):
        good = False
    if not good:
        raise DexgraspError(f"{what} as {{xyz: [x, y, z], rpy: [r, p, y]}}", repr(given), "m and rad, as in a URDF")
    matrix = trimesh.transformations.euler_matrix(rpy[0], rpy[1], rpy[2], "sxyz")
    matrix[:3, 3] = xyz
    return torch.from_numpy(matrix)


def _keep_chain(file: UrdfFile, flange: str) -> None:
    """Remove from the URDF what does not lie between its root and `flange`, nor is fixed to what does above it."""
    joints = {_end(joint, "child"): joint for joint in file.robot.findall("joint") if joint.find("child") is not None}
    names = [link.get("name", "") for link in file.robot.findall("link")]
    if flange not in names:
        raise DexgraspError(f"a link of {file.path} as `flange`", repr(flange), f"name one of {', '.join(names)}")
    chain, link = {flange}, flange
    while link in joints:
        link = _end(joints[link], "parent")
        chain.add(link)
    kept, above = set(chain), chain - {flange}
    while grown := {
        child
        for child, joint in joints.items()
        if child not in kept and _end(joint, "parent") in above and joint.get("type") == "fixed"
    }:
        kept |= grown
        above |= grown
    for element in [link for link in file.robot.findall("link") if link.get("name") not in kept]:
        file.robot.remove(element)
    for child, joint in joints.items():
        if child not in kept:
            file.robot.remove(joint)


def _end(joint: Any, end: str) -> str:
    return str(joint.find(end).get("link", ""))
