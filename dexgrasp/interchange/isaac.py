"""NVIDIA's isaac_grasp YAML, version 1.0: one gripper, one object; metres, radians, quaternions {w, xyz}."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import GraspSet, Posture, joined, posed, quaternions, wxyz
from dexgrasp.sensing.limits import GRASPS, head, sized
from dexgrasp.sensing.plain_yaml import read_yaml

VERSION = 1.0
PREGRASP = "pregrasp_cspace_position"


class Isaac(Format):
    """Reads and writes a file, or a folder of files of one gripper."""

    name = "isaac"
    summary = "Isaac grasp YAML 1.0: position, orientation, cspace_position of one gripper and object, or a folder"

    def recognises(self, path: Path) -> bool:
        """By its first key; one file is enough of a folder."""
        return bool(_files(path))

    def read(self, path: Path, told: Told) -> GraspSet:
        """Joints are those of `cspace_position`, the same in every grasp of all files, or those told."""
        files = _files(path) if path.is_dir() else [path]
        if not files:
            raise DexgraspError(f"files of isaac_grasp in {path}", "none", "check the path")
        first = self._read(files[0], told)
        same = replace(told, joints=first.joint_names)
        read = [first, *(self._read(file, same) for file in files[1:])]
        if len(grippers := {each.hand for each in read}) > 1:
            raise DexgraspError(f"one gripper in all files of {path}", ", ".join(sorted(grippers)), "read them apart")
        return joined(read)

    def _read(self, path: Path, told: Told) -> GraspSet:
        try:
            content = read_yaml(sized(path, GRASPS).read_text())
        except (OSError, ValueError, RecursionError, OverflowError, yaml.YAMLError) as error:
            raise DexgraspError(f"YAML in {path}", " ".join(str(error).split())[:200], "mend it") from error
        version = str(content.get("format_version")) if isinstance(content, dict) else ""
        if (
            not isinstance(content, dict)
            or content.get("format") != "isaac_grasp"
            or version not in (str(VERSION), "1")
        ):
            raise DexgraspError(f"format: isaac_grasp, format_version: {VERSION} in {path}", version, "convert it")
        grasps = content.get("grasps")
        if not isinstance(grasps, dict) or not grasps:
            raise DexgraspError(f"grasps in {path}", "none", "check the format")
        joints = told.joints or tuple(map(str, _map(next(iter(grasps.values())), "cspace_position", path)))
        position, turn, angles, before, scores = [], [], [], [], []
        for name, grasp in grasps.items():
            where = f"{name} in {path}"
            position.append(_numbers(_get(grasp, "position", where), 3, f"position of {where}"))
            orientation = _get(grasp, "orientation", where)
            w = _numbers([_get(orientation, "w", where)], 1, f"orientation.w of {where}")
            turn.append(w + _numbers(_get(orientation, "xyz", where), 3, f"orientation.xyz of {where}"))
            angles.append(_angles(_map(grasp, "cspace_position", where), joints, where))
            if PREGRASP in grasp:
                before.append(_angles(_map(grasp, PREGRASP, where), joints, where))
            scores += _numbers([grasp.get("confidence", np.nan)], 1, f"confidence of {where}")
        pose = posed(np.array(position), quaternions(np.array(turn), str(path)))
        scale = content.get("object_scale", 1.0 if told.scale is None else told.scale)
        count = len(grasps)
        return GraspSet(
            hand=told.robot or _frame(content, "gripper"),
            joint_names=joints,
            objects=(told.object or _frame(content, "object") or path.stem,) * count,
            grasp=Posture(pose, np.array(angles)),
            scale=np.full(count, _numbers([scale], 1, f"object_scale of {path}")[0]),
            score=np.array(scores),
            names=tuple(map(str, grasps)),
            pregrasp=Posture(pose, np.array(before)) if len(before) == count else None,
        )

    def write(self, grasps: GraspSet, path: Path) -> Path:
        """Write one file, or into a folder one for each object and scale; `object_scale` is a key of ours.

        Pre-grasps are kept where only joints differ.
        """
        bodies = grasps.bodies()
        if path.suffix not in (".yaml", ".yml"):
            for name, scale in bodies:
                self.write(grasps.rows(grasps.of(name, scale)), path / f"{Path(name).name}_{scale:.6g}.yaml")
            return path
        if len(bodies) != 1:
            found = f"{len(bodies)}: {', '.join(name for name, _ in bodies[:5])}"
            raise DexgraspError(
                "grasps of one object of one scale, as isaac_grasp holds", found, "write into a folder: a file for each"
            )
        if len(set(grasps.names)) < len(grasps):
            raise DexgraspError("grasps of different names", "some of one name", "rename them")
        turn, before = wxyz(grasps.grasp.pose), grasps.pregrasp
        if before is not None and not np.allclose(before.pose, grasps.grasp.pose, atol=1e-9):
            before = None
        told = {}
        for row, name in enumerate(grasps.names):
            told[name] = {
                "confidence": 1.0 if np.isnan(grasps.score[row]) else float(grasps.score[row]),
                "position": grasps.grasp.pose[row, :3, 3].tolist(),
                "orientation": {"w": float(turn[row, 0]), "xyz": turn[row, 1:].tolist()},
                "cspace_position": dict(zip(grasps.joint_names, grasps.grasp.joints[row].tolist(), strict=True)),
            }
            if before is not None:
                told[name][PREGRASP] = dict(zip(grasps.joint_names, before.joints[row].tolist(), strict=True))
        content: dict[str, Any] = {"format": "isaac_grasp", "format_version": VERSION}
        content |= {"object_frame": bodies[0][0], "gripper_frame": grasps.hand, "object_scale": bodies[0][1]}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(content | {"grasps": told}, sort_keys=False, default_flow_style=None))
        return path


def _files(path: Path) -> list[Path]:
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [file for file in files if file.is_file() and file.suffix in (".yaml", ".yml")]
    return [file for file in files if b"isaac_grasp" in head(file, 4096)]


def _frame(content: dict[str, Any], what: str) -> str:
    """Return the last part of a frame's name: /World/mug is the mug."""
    return str(content.get(f"{what}_frame") or content.get(f"{what}_frame_link") or "").rpartition("/")[2]


def _get(entry: Any, key: str, where: str) -> Any:
    if not isinstance(entry, dict) or key not in entry:
        raise DexgraspError(f"{key} of {where}", "none", "mend the file")
    return entry[key]


def _map(entry: Any, key: str, where: Any) -> dict[str, Any]:
    found = _get(entry, key, str(where))
    if not isinstance(found, dict) or not found:
        raise DexgraspError(f"{key} of {where}: joint names with values", repr(found), "mend the file")
    return found


def _angles(found: dict[str, Any], joints: tuple[str, ...], where: str) -> list[float]:
    if set(found) != set(joints):
        strange, missing = sorted(set(found) - set(joints)), sorted(set(joints) - set(found))
        told = f"unknown {', '.join(strange) or 'none'}; missing {', '.join(missing) or 'none'}"
        raise DexgraspError(f"joints {', '.join(joints)} of {where}", told, "name the same joints in all grasps")
    return _numbers([found[name] for name in joints], len(joints), f"joints of {where}")


def _numbers(values: Any, count: int, where: str) -> list[float]:
    good = isinstance(values, list) and len(values) == count
    if not good or not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        raise DexgraspError(f"{where}: {count} numbers", repr(values)[:100], "mend the file")
    return [float(value) for value in values]
