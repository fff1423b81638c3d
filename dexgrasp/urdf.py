"""A hand from a URDF and a few lines of YAML."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.fingertip import fit_fingertip
from dexgrasp.hand import Finger, Hand
from dexgrasp.kinematics import KinematicTree, LinkRecord
from dexgrasp.synergies import Synergy
from dexgrasp.urdf_file import UrdfFile
from dexgrasp.urdf_geometry import convex_pieces, joined, link_meshes

VIRTUAL_REACH = 0.03
"""Distance from fingertip centre to the virtual outer joint of a prismatic finger, m."""

FINGER_KEYS = ("name", "link", "closing", "tip_radius", "tip_center", "closing_axis", "outer_joint")


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
        least_fingers: fewest fingers that touch in a grasp.
        root: link at which the hand begins, where the URDF holds a whole arm; the base frame is its frame.
        palm: a link whose frame is the palm frame, or {origin, approach} in the base frame.
        couplings: {joint: {joint, multiplier (1), offset (0)}}, in place of `<mimic>` tags that are wrong or missing;
            null frees a joint.
        limits: {joint: [lower, upper]}, rad or m, in place of the URDF's.
        efforts: {joint: N m or N}, in place of the URDF's, which often are not the real ones.
        allowed_contacts: pairs of links that may overlap, besides neighbours and what does so in the open posture.
        collision: `given` (the URDF's `<collision>`) or `visual`; default: `given`, where the URDF has none at all
            `visual`. What is not convex is cut into convex parts (see `convex_pieces`).
        model: nothing but a key that the YAML's `urdf` may be composed from, where a hand comes in several models.
        synergies: {name: synergy}, postures that synthesis draws from, see `dexgrasp.synergies.Synergy.read`.

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
        least_fingers: int = 2,
        root: str | None = None,
        palm: str | Mapping[str, Sequence[float]] | None = None,
        couplings: Mapping[str, Mapping[str, Any] | None] | None = None,
        limits: Mapping[str, Sequence[float]] | None = None,
        efforts: Mapping[str, float] | None = None,
        allowed_contacts: Sequence[Sequence[str]] = (),
        collision: str | None = None,
        model: str | None = None,
        synergies: Mapping[str, Any] | None = None,
    ) -> None:
        self.name, self.urdf = name, Path(urdf)
        self.couplings = dict(couplings or {})
        """What replaces `<mimic>` tags of the URDF."""
        file = UrdfFile(self.urdf, root, couplings, limits, efforts)
        self.model = file.model()
        self.kinematics = KinematicTree(self.model)
        self.tree: tuple[LinkRecord, ...] = self.kinematics.records
        self.link_names = self.kinematics.names
        self.full_joint_names = tuple(self.model.names[1:])
        self.joint_names = file.free(self.full_joint_names)
        self.coupling = file.coupling(self.full_joint_names, self.joint_names)
        self.limits = torch.tensor([file.limits(joint) for joint in self.joint_names], dtype=torch.float64)
        self.efforts = torch.tensor([file.effort(joint) for joint in self.joint_names], dtype=torch.float64)
        self.masses = file.masses()
        visuals = link_meshes(file.robot, "visual", self.urdf)
        self.visuals = {link: joined(meshes) for link, meshes in visuals.items()}
        self._known([] if collision is None else [collision], ("given", "visual"), "source of collision geometry")
        solids = {} if collision == "visual" else link_meshes(file.robot, "collision", self.urdf)
        solids = visuals if collision == "visual" or not (solids or collision) else solids
        self.collisions = {
            link: tuple(part for mesh in meshes for part in convex_pieces(mesh, link))
            for link, meshes in solids.items()
        }
        self._known([link for pair in allowed_contacts for link in pair], self.link_names, "link")
        self.allowed_contacts = tuple((str(first), str(second)) for first, second in allowed_contacts)
        self._known(shared, self.joint_names, "shared joint")
        self.shared = tuple(joint for joint in self.joint_names if joint in shared)
        self.base_T_palm = self._palm(palm)
        self.fingers = tuple(self._finger(finger) for finger in fingers)
        if not 2 <= least_fingers <= max(len(self.fingers), 2):
            raise DexgraspError(
                f"least_fingers of 2 to {len(self.fingers)}", repr(least_fingers), f"mend it in the YAML of {name!r}"
            )
        self.least_fingers = least_fingers
        self.synergies = {name: Synergy.read(name, given, self) for name, given in (synergies or {}).items()}

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
        self._known(list(given), FINGER_KEYS, "key of a finger")
        link = str(given.get("link", ""))
        self._known([link], self.link_names, "link")
        path = self._path(link)
        joints = [record for record in path if record.joint is not None]
        if not joints:
            raise DexgraspError(f"a movable joint above link {link!r}", "none", f"correct the finger in {self.name!r}")
        matrix = self.coupling[0]
        moved = matrix[[record.index for record in joints]].abs().sum(dim=0) > 0
        chain = tuple(name for name, used in zip(self.joint_names, moved.tolist(), strict=True) if used)
        main = tuple(name for name in self.joint_names if name in chain or name in self.shared)
        closing = {str(key): float(value) for key, value in (given.get("closing") or {}).items()}
        self._known(list(closing), self.joint_names, "independent joint")
        closing = closing or self._flexion(joints)
        rates = torch.tensor([closing.get(joint, 0.0) for joint in self.joint_names], dtype=torch.float64)
        sign = -1.0 if float(matrix[joints[-1].index] @ rates) < 0 else 1.0
        geometry = self._tip(given, path, sign)
        if "closing_axis" not in given and joints[-1].kind == "revolute":
            # Of a linkage the last joint may turn back while the finger closes: what counts is where the tip goes.
            opposed = self._travel(link, geometry[1], rates) @ np.cross(geometry[3], geometry[2] - geometry[1])
            geometry = (*geometry[:3], -geometry[3] if opposed > 0 else geometry[3])
        return Finger(
            name=str(given.get("name", link)),
            link=link,
            tip_radius=geometry[0],
            tip_center=torch.from_numpy(geometry[1]),
            outer_joint=torch.from_numpy(geometry[2]),
            closing_axis=torch.from_numpy(geometry[3]),
            chain=chain,
            main=main,
            supporting=tuple(joint for joint in self.joint_names if joint not in main),
            closing=closing,
        )

    def _tip(
        self, given: Mapping[str, Any], path: list[LinkRecord], sign: float
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Return tip radius, tip centre, outer joint and closing axis in link coordinates; `sign` closes."""
        last = next(record for record in reversed(path) if record.joint is not None)
        last_T_link = np.eye(4)
        for record in path[path.index(last) + 1 :]:
            last_T_link = last_T_link @ record.parent_T_joint
        link_T_last = np.linalg.inv(last_T_link)
        origin, direction = link_T_last[:3, 3], link_T_last[:3, :3] @ last.axis * sign
        slides = last.kind == "prismatic"
        axis, distal = direction, None
        if slides:
            # A slide has no closing axis: METHOD section 1 takes w ~ u x (closing direction reversed), and a virtual
            # joint behind and outside the pad, at 45 deg.
            pose = self.link_poses(self.limits.mean(dim=1, keepdim=True).T)[path[-1].name][0]
            distal = (pose[:3, :3].T @ self.base_T_palm[:3, 2]).numpy()
            distal = distal - (distal @ direction) * direction
            distal /= np.linalg.norm(distal)
            axis = np.cross(distal, direction)
        if "closing_axis" in given:
            axis = np.array(given["closing_axis"], dtype=np.float64)
        axis = axis / np.linalg.norm(axis)
        if "tip_center" in given and "tip_radius" in given:
            center, radius = np.array(given["tip_center"], dtype=np.float64), float(given["tip_radius"])
        else:
            center, radius = fit_fingertip(self._solid(path[-1].name), origin, axis, distal)
        if slides:
            origin = center - VIRTUAL_REACH * (direction + distal) / math.sqrt(2)
        else:  # the point of the joint's axis in the circle's plane
            origin = origin + ((center - origin) @ axis) * axis
        if "outer_joint" in given:
            origin = np.array(given["outer_joint"], dtype=np.float64)
        return radius, center, origin.copy(), axis

    def _travel(self, link: str, point: np.ndarray, rates: Float[Tensor, "J"]) -> np.ndarray:
        """Return how a link's point moves, in its coordinates, when joints move at `rates` in mid-range."""
        middle, step = self.limits.mean(dim=1), 1e-4
        near = self.link_poses(torch.stack([middle - step * rates, middle + step * rates]))[link].numpy()
        ends = near[:, :3, :3] @ point + near[:, :3, 3]
        return (ends[1] - ends[0]) @ near[0, :3, :3]

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
            return joined(self.collisions[link])
        raise DexgraspError(
            f"geometry of link {link!r} to fit the fingertip to",
            "neither visual nor collision",
            "name a link that has some, or give tip_radius and tip_center in the hand's YAML",
        )
