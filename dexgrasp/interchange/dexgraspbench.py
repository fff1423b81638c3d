"""DexGraspBench (Chen et al. 2024): one pickled dictionary a .npy file, or a folder of them.

`grasp_qpos`, and perhaps `pregrasp_qpos` and `squeeze_qpos`: base position (m), quaternion w x y z, joints (rad), in
the world, where the object stands at `obj_pose` with its mesh times `obj_scale`; `obj_path`. The joints have no names
there; we add `joint_names`, which the benchmark does not look at.
"""

from pathlib import Path
from typing import Any

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import Array, GraspSet, Posture, posed, quaternions, wxyz
from dexgrasp.interchange.pickled import read_npy
from dexgrasp.sensing.limits import GRASPS, head

STAGES = {"grasp": "grasp_qpos", "pregrasp": "pregrasp_qpos", "squeeze": "squeeze_qpos"}
FINGERS = {"FF": "4321", "MF": "4321", "RF": "4321", "LF": "54321", "TH": "54321"}
HANDS = {
    "shadow": tuple(f"rh_{finger}J{number}" for finger, numbers in FINGERS.items() for number in numbers),
    "allegro": tuple(f"{finger}j{number}" for finger in ("ff", "mf", "rf", "th") for number in range(4)),
}
"""The order of the joints in the benchmark's own hand models; numbers of joints tell them apart, if nothing else."""


class DexGraspBench(Format):
    """Reads and writes."""

    name = "dexgraspbench"
    summary = "DexGraspBench: .npy of a pickled dictionary with grasp_qpos, or a folder of them"

    def recognises(self, path: Path) -> bool:
        """One file is enough of a folder."""
        files = _files(path)
        return bool(files) and b"grasp_qpos" in head(files[0], GRASPS)

    def read(self, path: Path, told: Told) -> GraspSet:
        """Joint names are the file's `joint_names`, or those told, or for 22 and 16 joints the benchmark's hands'."""
        files = _files(path)
        if not files:
            raise DexgraspError(f"a .npy file or a folder of them at {path}", "none", "check the path")
        parts = [_read(file, told) for file in files]
        names = {part[0] for part in parts}
        if len(names) > 1:
            a, b = sorted(names)[:2]
            raise DexgraspError(f"the same joints in all files of {path}", f"{a} and {b}", "read them apart")
        stages = {stage: [part[1].get(stage) for part in parts] for stage in STAGES}
        world = np.concatenate([part[2] for part in parts])
        back = np.linalg.inv(world)
        joint_names = names.pop()
        postures: dict[str, Any] = {
            stage: _posture(np.concatenate(given), back, len(joint_names), str(path))  # type: ignore[arg-type]
            for stage, given in stages.items()
            if all(each is not None for each in given)
        }
        same = next((hand for hand, known in HANDS.items() if known == joint_names), "")
        return GraspSet(
            hand=told.robot or parts[0][6] or same,
            joint_names=joint_names,
            objects=tuple(name for part in parts for name in part[3]),
            scale=np.concatenate([part[4] for part in parts]),
            score=np.full(len(world), np.nan),
            names=tuple(name for part in parts for name in part[5]),
            world_T_object=None if (world == np.eye(4)).all() else world,
            **postures,
        )

    def write(self, grasps: GraspSet, path: Path) -> Path:
        """Write `path`/<object>/<scale>/<name>.npy for each grasp; object_T_base becomes world_T_base."""
        world = grasps.world_T_object
        world = np.tile(np.eye(4), (len(grasps), 1, 1)) if world is None else world
        given = {stage: getattr(grasps, stage) for stage in STAGES}
        flat = {key: _qpos(given[stage], world) for stage, key in STAGES.items() if given[stage] is not None}
        stood = np.concatenate([world[:, :3, 3], wxyz(world)], axis=1)
        for row in range(len(grasps)):
            content: dict[str, Any] = {key: values[row] for key, values in flat.items()}
            content |= {"obj_pose": stood[row], "obj_scale": float(grasps.scale[row]), "obj_path": grasps.objects[row]}
            content |= {"joint_names": list(grasps.joint_names), "hand_name": grasps.hand}
            folder = path / Path(grasps.objects[row]).name / f"scale{grasps.scale[row]:.6g}"
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"{grasps.names[row]}.npy"
            if file.exists():
                raise DexgraspError(f"no file {file} yet", "one", "write into a new folder")
            np.save(file, np.array(content, dtype=object), allow_pickle=True)
        return path


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(path.rglob("*.npy"), key=lambda file: [_number(part) for part in file.parts])
    return [path] if path.is_file() and path.suffix == ".npy" else []


def _number(text: str) -> tuple[int, str]:
    """grasp_2 before grasp_10."""
    digits = "".join(filter(str.isdigit, Path(text).stem))
    return int(digits) if digits and len(digits) < 9 else 0, text


def _read(file: Path, told: Told) -> tuple[tuple[str, ...], dict[str, Array], Array, list[str], Array, list[str], str]:
    """Return joint names, qpos of each stage (N, 7 + J), world_T_object, object, scale and name of each, and hand."""
    content = read_npy(file)
    if not isinstance(content, dict) or "grasp_qpos" not in content:
        found = f"keys {sorted(map(str, content))}" if isinstance(content, dict) else type(content).__name__
        raise DexgraspError(f"a dictionary with grasp_qpos in {file}", found, "check the format")
    stages = {stage: _table(content[key], file, key) for stage, key in STAGES.items() if content.get(key) is not None}
    count, width = stages["grasp"].shape
    if any(stage.shape != (count, width) for stage in stages.values()):
        shapes = {name: stage.shape for name, stage in stages.items()}
        raise DexgraspError(f"qpos of one shape in {file}", str(shapes), "mend the file")
    inside = tuple(map(str, content.get("joint_names", ())))
    if inside and told.joints and inside != told.joints:
        raise DexgraspError(
            f"the joints that {file} names: {', '.join(inside)}", ", ".join(told.joints), "leave it out"
        )
    known = next((names for names in HANDS.values() if len(names) == width - 7), ())
    names = Told(joints=inside or told.joints).joints_of(width - 7, str(file), known)
    scale = content.get("obj_scale", told.scale)
    if scale is None:
        raise DexgraspError(f"obj_scale in {file}", "none: the mesh has no unit", "tell it: scale=0.06")
    stood = _table(content.get("obj_pose", [0.0, 0, 0, 1, 0, 0, 0]), file, "obj_pose")
    if stood.shape[1] != 7 or len(stood) not in (1, count):
        raise DexgraspError(f"obj_pose of 7 numbers in {file}", str(stood.shape), "mend the file")
    world = posed(stood[:, :3], quaternions(stood[:, 3:], f"obj_pose in {file}"))
    name = told.object or Path(str(content.get("obj_path", file.parent.name))).name
    labels = [file.stem] if count == 1 else [f"{file.stem}_{row}" for row in range(count)]
    scales = np.broadcast_to(np.asarray(scale, dtype=np.float64).reshape(-1), (count,)).copy()
    hand = str(content.get("hand_name", ""))
    return names, stages, np.broadcast_to(world, (count, 4, 4)).copy(), [name] * count, scales, labels, hand


def _table(value: Any, file: Path, key: str) -> Array:
    try:
        table = np.atleast_2d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise DexgraspError(f"numbers in {key} of {file}", str(error), "mend the file") from error
    if table.ndim != 2 or table.shape[1] < 7:
        raise DexgraspError(f"rows of 7 numbers and joints in {key} of {file}", str(table.shape), "mend the file")
    return table


def _posture(qpos: Array, object_T_world: Array, joints: int, where: str) -> Posture:
    pose = posed(qpos[:, :3], quaternions(qpos[:, 3:7], f"qpos in {where}"))
    return Posture(object_T_world @ pose, qpos[:, 7 : 7 + joints])


def _qpos(posture: Posture, world: Array) -> Array:
    pose = world @ posture.pose
    return np.concatenate([pose[:, :3, 3], wxyz(pose), posture.joints], axis=1)
