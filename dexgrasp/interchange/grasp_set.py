"""Grasps as a file tells them: joints by name, the hand against each object, metres and radians."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from dexgrasp.errors import DexgraspError

Array = np.ndarray
RIGID = 1e-3
"""Most by which a rotation may miss being one; files keep few digits. What is read is made exact."""


@dataclass(frozen=True, eq=False)
class Posture:
    """Where N hands are and how they are bent."""

    pose: Float[Array, "N 4 4"]
    """object_T_base, m; the object's frame is that of its mesh, scaled to metres."""
    joints: Float[Array, "N J"]
    """In the order of `GraspSet.joint_names`, rad (m where prismatic)."""

    def rows(self, which: Any) -> "Posture":
        """Return some of them."""
        return Posture(self.pose[which], self.joints[which])


@dataclass(frozen=True, eq=False)
class GraspSet:
    """N grasps of one hand on any objects. Nothing here needs the hand to be installed.

    Raises DexgraspError for what is no grasp: joints named twice, rotations that are none, numbers that are not
    finite, scales that are missing.
    """

    hand: str
    """As the file names it; empty where it does not."""
    joint_names: tuple[str, ...]
    objects: tuple[str, ...]
    """Object of each grasp."""
    grasp: Posture
    scale: Float[Array, "N"]
    """Metres per unit of the object's mesh file."""
    score: Float[Array, "N"]
    """What the file says of each grasp, more is better; NaN where it says nothing."""
    names: tuple[str, ...] = ()
    """Of each grasp."""
    pregrasp: Posture | None = None
    squeeze: Posture | None = None
    """Postures before and after, where the file tells them."""
    world_T_object: Float[Array, "N 4 4"] | None = field(default=None)
    """Where the objects stood, m; None: in their own frames."""
    touching: Bool[Array, "N F"] | None = field(default=None)
    """Which fingers close until they touch, in the hand's order; None: all. Only our own files tell."""

    def __post_init__(self) -> None:
        count = len(self.objects)
        if not self.names:
            object.__setattr__(self, "names", tuple(f"grasp_{i}" for i in range(count)))
        twice = sorted({name for name in self.joint_names if self.joint_names.count(name) > 1})
        if twice:
            raise DexgraspError("each joint named once", f"twice: {', '.join(twice)}", "mend the joint names")
        for what, posture in self._postures():
            wanted = (count, 4, 4), (count, len(self.joint_names))
            found = posture.pose.shape, posture.joints.shape
            if found != wanted:
                raise DexgraspError(f"{what}: poses and joints of shape {wanted}", str(found), "give one row a grasp")
            _check_rigid(posture.pose, what)
            _finite(posture.joints, f"joints of the {what}")
        if self.world_T_object is not None:
            _check_rigid(self.world_T_object, "object")
        if self.touching is not None and len(self.touching) != count:
            raise DexgraspError(
                f"touching fingers of {count} grasps", f"of {len(self.touching)}", "give one row a grasp"
            )
        if len(self.scale) != count or len(self.score) != count or len(self.names) != count:
            raise DexgraspError(f"{count} scales, scores and names", "other numbers of them", "give one a grasp")
        if not (np.isfinite(self.scale).all() and (self.scale > 0).all()):
            raise DexgraspError("the scale of each mesh in metres per unit, above 0", "one that is none", "tell it")

    def __len__(self) -> int:
        return len(self.objects)

    def _postures(self) -> list[tuple[str, Posture]]:
        given = (("grasp", self.grasp), ("pregrasp", self.pregrasp), ("squeeze", self.squeeze))
        return [(what, posture) for what, posture in given if posture is not None]

    def rows(self, which: Sequence[int] | Array) -> "GraspSet":
        """Return some of the grasps, in the order of `which`."""
        index = np.asarray(which, dtype=np.int64)
        changed: dict[str, Any] = {}
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, Posture):
                changed[each.name] = value.rows(index)
            elif isinstance(value, np.ndarray):
                changed[each.name] = value[index]
            elif each.name in ("objects", "names"):
                changed[each.name] = tuple(value[i] for i in index)
        return replace(self, **changed)

    def bodies(self) -> list[tuple[str, float]]:
        """Return each object with each of its scales once, in order of appearance."""
        return list(dict.fromkeys(zip(self.objects, self.scale.tolist(), strict=True)))

    def of(self, name: str, scale: float) -> Array:
        """Return the rows of one of `bodies`."""
        same = np.array([other == name for other in self.objects], dtype=bool)
        return np.flatnonzero(same & (self.scale == scale))


def joined(sets: Sequence[GraspSet]) -> GraspSet:
    """Return grasps of one hand, joints in the same order, as one set; what one of the sets does not tell is left."""
    changed: dict[str, Any] = {}
    for each in fields(GraspSet):
        values = [getattr(one, each.name) for one in sets]
        if any(value is None for value in values):
            changed[each.name] = None
        elif isinstance(values[0], Posture):
            poses, joints = [value.pose for value in values], [value.joints for value in values]
            changed[each.name] = Posture(np.concatenate(poses), np.concatenate(joints))
        elif isinstance(values[0], np.ndarray):
            changed[each.name] = np.concatenate(values)
        elif each.name in ("objects", "names"):
            changed[each.name] = tuple(name for value in values for name in value)
    return replace(sets[0], **changed)


def posed(position: Float[Array, "N 3"], rotation: Float[Array, "N 3 3"]) -> Float[Array, "N 4 4"]:
    """Join positions (m) and rotations into homogeneous matrices."""
    pose = np.tile(np.eye(4), (len(position), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = rotation, position
    return pose


def quaternions(wxyz: Float[Array, "N 4"], where: str) -> Float[Array, "N 3 3"]:
    """Return the rotations of quaternions (w, x, y, z); raises DexgraspError where they are not of length 1."""
    from scipy.spatial.transform import Rotation

    lengths = np.linalg.norm(wxyz, axis=1)
    if not (np.abs(lengths - 1) < 0.01).all():
        worst = lengths[np.abs(lengths - 1).argmax()] if np.isfinite(lengths).all() else np.nan
        raise DexgraspError(f"{where}: quaternions w x y z of length 1", f"length {worst:g}", "mend the file")
    return np.asarray(Rotation.from_quat(wxyz, scalar_first=True).as_matrix()).reshape(-1, 3, 3)


def wxyz(pose: Float[Array, "N 4 4"]) -> Float[Array, "N 4"]:
    """Return the quaternions (w, x, y, z) of poses, w not negative."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(pose[:, :3, :3].reshape(-1, 3, 3))
    return np.asarray(turned.as_quat(scalar_first=True, canonical=True)).reshape(-1, 4)


def _finite(values: Array, where: str) -> None:
    if not np.isfinite(values).all():
        raise DexgraspError(f"{where}: finite numbers", "NaN or infinity", "mend the file")


def _check_rigid(pose: Float[Array, "N 4 4"], where: str) -> None:
    _finite(pose, f"pose of the {where}")
    rotation = pose[:, :3, :3]
    off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if off > RIGID or (np.linalg.det(rotation) < 0).any():
        found = f"one that misses it by {off:.2g}, or mirrors"
        raise DexgraspError(f"a rotation in every pose of the {where}", found, "mend the poses")
