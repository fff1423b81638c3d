"""Grasps of a file as grasps of an installed hand."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.interchange.grasp_set import Array, GraspSet, Posture, posed, quaternions
from dexgrasp.sensing.limits import TEXT, sized
from dexgrasp.sensing.plain_yaml import read_yaml
from dexgrasp.settings import read

BEYOND = 0.02
"""Joints may lie this far beyond a limit, rad or m: files are rounded, hand models differ. They are clamped."""


@dataclass(frozen=True)
class Description:
    """How another description of a hand becomes ours."""

    joints: Mapping[str, str] = field(default_factory=dict)
    """Their joint: our joint. Joints that are not here keep their name."""
    signs: Mapping[str, float] = field(default_factory=dict)
    """Their joint: -1 where it turns the other way."""
    offsets: Mapping[str, float] = field(default_factory=dict)
    """Their joint: what is added then, rad or m."""
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Our base in theirs, m."""
    orientation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    """Our base in theirs, quaternion w x y z."""


def load_mapping(path: str | Path | None) -> Description:
    """Return the mapping of a YAML file; nothing is changed where there is none."""
    if path is None:
        return Description()
    try:
        content = read_yaml(sized(Path(path), TEXT).read_text())
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise DexgraspError(f"a YAML file {path}", str(error), "check the path") from error
    if not isinstance(content, dict):
        raise DexgraspError(f"a mapping in {path}", type(content).__name__, "see docs/interchange.md")
    return read(Description, content, str(path))


def renamed(grasps: GraspSet, mapping: Description) -> GraspSet:
    """Return grasps told of our hand instead of theirs: joints renamed and turned, our base in place of theirs."""
    strange = sorted({*mapping.joints, *mapping.signs, *mapping.offsets} - set(grasps.joint_names))
    if strange:
        expected = f"joints of the file: {', '.join(grasps.joint_names)}"
        raise DexgraspError(expected, ", ".join(strange), "correct the mapping")
    signs = np.array([mapping.signs.get(name, 1.0) for name in grasps.joint_names])
    offsets = np.array([mapping.offsets.get(name, 0.0) for name in grasps.joint_names])
    turn = quaternions(np.array([mapping.orientation], dtype=np.float64), "orientation of the mapping")
    theirs_T_ours = posed(np.array([mapping.position], dtype=np.float64), turn)[0]
    changed: dict[str, Any] = {}
    for stage in ("grasp", "pregrasp", "squeeze"):
        posture: Posture | None = getattr(grasps, stage)
        if posture is not None:
            changed[stage] = Posture(posture.pose @ theirs_T_ours, signs * posture.joints + offsets)
    names = tuple(mapping.joints.get(name, name) for name in grasps.joint_names)
    return GraspSet(**{**vars(grasps), **changed, "joint_names": names})


@dataclass(frozen=True)
class Bound:
    """Grasps of an installed hand, and what had to be changed for it."""

    grasps: Grasps
    """In the hand's order of joints, object frame, float64; `object` counts `GraspSet.bodies`."""
    uncoupled: float
    """Largest difference between a coupled joint of the file and what the hand's coupling gives, rad or m."""
    clamped: int
    """Grasps that lay a little beyond a joint's limit."""


def bind(grasps: GraspSet, hand: Hand) -> Bound:
    """Return the grasps as those of `hand`; every independent joint must be named, every name be one of its joints.

    Coupled joints may be told too; the hand's coupling decides. Raises DexgraspError for joints that are unknown or
    missing, and for angles beyond the limits by more than `BEYOND`.
    """
    full = list(getattr(hand, "full_joint_names", hand.joint_names))
    strange = [name for name in grasps.joint_names if name not in full]
    missing = [name for name in hand.joint_names if name not in grasps.joint_names]
    if strange or missing:
        found = f"unknown {', '.join(strange) or 'none'}; missing {', '.join(missing) or 'none'}"
        remedy = "choose the right hand, or rename: map=FILE (docs/interchange.md)"
        raise DexgraspError(f"joints of {hand.name}: {', '.join(hand.joint_names)}", found, remedy)
    column = {name: grasps.grasp.joints[:, place] for place, name in enumerate(grasps.joint_names)}
    joints = np.stack([column[name] for name in hand.joint_names], axis=1)
    limits = hand.limits.numpy()
    beyond = np.maximum(limits[:, 0] - joints, joints - limits[:, 1])
    if (beyond > BEYOND).any():
        row, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        low, high = limits[joint]
        where = f"{hand.joint_names[joint]} of {grasps.names[row]}"
        remedy = "check units and joint names; other limits are a variant of the hand's YAML"
        raise DexgraspError(f"{where} between {low:.4g} and {high:.4g}", f"{joints[row, joint]:.4g}", remedy)
    uncoupled = _uncoupled(hand, column, joints, full)
    bodies = {body: number for number, body in enumerate(grasps.bodies())}
    owners = [bodies[body] for body in zip(grasps.objects, grasps.scale.tolist(), strict=True)]
    pose = torch.from_numpy(grasps.grasp.pose.copy())
    touching = None if grasps.touching is None else torch.from_numpy(grasps.touching.copy())
    if touching is not None and touching.shape != (len(grasps), len(hand.fingers)):
        expected = f"which of the {len(hand.fingers)} fingers of {hand.name} touch in each grasp"
        raise DexgraspError(expected, f"shape {tuple(touching.shape)}", "choose the right hand")
    made = Grasps.build(pose, hand.clamp(torch.from_numpy(joints)), len(hand.fingers), touching=touching)
    score = torch.from_numpy(np.nan_to_num(grasps.score))
    made = made.replace(object=torch.tensor(owners, dtype=torch.long), quality=score)
    return Bound(made, uncoupled, int((beyond > 1e-9).any(axis=1).sum()))


def _uncoupled(hand: Hand, column: Mapping[str, Array], joints: Array, full: list[str]) -> float:
    told = [name for name in full if name in column and name not in hand.joint_names]
    if not told:
        return 0.0
    matrix, offset = (np.asarray(part) for part in hand.coupling)  # type: ignore[attr-defined]
    follow = joints @ matrix.T + offset
    return max(float(np.abs(column[name] - follow[:, full.index(name)]).max(initial=0.0)) for name in told)


def unbound(grasps: Grasps, hand: Hand, objects: tuple[str, ...]) -> GraspSet:
    """Return grasps of a hand (object frame) as a file can tell them; `objects` has the name of each grasp's object."""
    poses, joints = grasps.pose.double().cpu().numpy(), grasps.joints.double().cpu().numpy()
    return GraspSet(
        hand=hand.name,
        joint_names=tuple(hand.joint_names),
        objects=objects,
        grasp=Posture(poses, joints),
        scale=np.ones(len(grasps)),
        score=grasps.quality.double().cpu().numpy(),
        touching=grasps.touching.cpu().numpy(),
    )
