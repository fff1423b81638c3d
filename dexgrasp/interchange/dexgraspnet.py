"""DexGraspNet (Wang et al. 2023): a list of {qpos: {joint: rad, WRJT*: m, WRJR*: rad}, scale}, as npy or JSON.

The wrist's angles are Euler angles about fixed axes x, y, z; positions are in the frame of the object's mesh times
`scale`. The file's name is the object's.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import GraspSet, Posture, posed
from dexgrasp.interchange.pickled import read_npy
from dexgrasp.sensing.limits import GRASPS, head, sized

PLACE = ("WRJTx", "WRJTy", "WRJTz")
TURN = ("WRJRx", "WRJRy", "WRJRz")
FINGERS = {"FF": "3210", "MF": "3210", "RF": "3210", "LF": "43210", "TH": "43210"}
SHADOW = tuple(f"robot0:{finger}J{number}" for finger, numbers in FINGERS.items() for number in numbers)
HANDS = {"shadow": SHADOW, "allegro": tuple(f"joint_{number}.0" for number in range(16))}
"""The hands that were published in this format, by their joints."""


class DexGraspNet(Format):
    """Reads npy and JSON."""

    name = "dexgraspnet"
    summary = "DexGraspNet: .npy or .json of {qpos, scale}; Shadow and Allegro hand"

    def recognises(self, path: Path) -> bool:
        """JSON or a pickled list whose beginning speaks of qpos."""
        if not path.is_file() or path.suffix not in (".json", ".npy"):
            return False
        start = head(path, 4000)
        return b"qpos" in start[:600] and b"WRJ" in start and b"grasp_qpos" not in start[:600]

    def read(self, path: Path, told: Told) -> GraspSet:
        """Joint names are those of a published hand, or those told."""
        entries = _entries(path)
        names = tuple(name for name in _qpos(entries[0], path, 0) if name not in (*PLACE, *TURN))
        hand, right = told.robot, told.joints
        if not right:
            near = max(HANDS, key=lambda key: len(set(HANDS[key]) & set(names)))
            hand, right = hand or near, HANDS[near]
        numbers = np.array([_numbers(entry, right, path, row) for row, entry in enumerate(entries)])
        scale = [_scale(entry, path, row, told) for row, entry in enumerate(entries)]
        from scipy.spatial.transform import Rotation

        rotation = np.asarray(Rotation.from_euler("xyz", numbers[:, 3:6]).as_matrix())
        return GraspSet(
            hand=hand,
            joint_names=tuple(right),
            objects=(told.object or path.stem,) * len(entries),
            grasp=Posture(posed(numbers[:, :3], rotation), numbers[:, 6:]),
            scale=np.array(scale, dtype=np.float64),
            score=np.full(len(entries), np.nan),
        )


def _entries(path: Path) -> list[Any]:
    try:
        content = json.loads(sized(path, GRASPS).read_text()) if path.suffix == ".json" else read_npy(path)
    except (ValueError, OSError, RecursionError) as error:
        raise DexgraspError(
            f"grasps of DexGraspNet in {path}", f"{type(error).__name__}: {error}", "mend it"
        ) from error
    if not isinstance(content, list) or not content:
        raise DexgraspError(f"a list of grasps in {path}", f"{type(content).__name__}", "check the format")
    return content


def _qpos(entry: Any, path: Path, row: int) -> dict[str, Any]:
    qpos = entry.get("qpos") if isinstance(entry, dict) else None
    if not isinstance(qpos, dict):
        raise DexgraspError(f"qpos of grasp {row} in {path}", "none", "check the format")
    return qpos


def _numbers(entry: Any, names: tuple[str, ...], path: Path, row: int) -> list[float]:
    qpos = _qpos(entry, path, row)
    wanted = (*PLACE, *TURN, *names)
    strange, missing = sorted(set(qpos) - set(wanted)), sorted(set(wanted) - set(qpos))
    if strange or missing:
        found = f"unknown {', '.join(map(str, strange)) or 'none'}; missing {', '.join(missing) or 'none'}"
        remedy = "correct the names, or tell those of your hand: joints=a,b,c"
        raise DexgraspError(f"joints {', '.join(names)} and WRJ* of grasp {row} in {path}", found, remedy)
    try:
        return [float(qpos[name]) for name in wanted]
    except (TypeError, ValueError, OverflowError) as error:
        raise DexgraspError(f"numbers in grasp {row} of {path}", str(error), "mend the file") from error


def _scale(entry: Any, path: Path, row: int, told: Told) -> float:
    scale = entry.get("scale", told.scale)
    if not isinstance(scale, int | float | np.number) or isinstance(scale, bool):
        remedy = "the mesh has no unit without it; tell it: scale=0.08"
        raise DexgraspError(f"the mesh's scale with grasp {row} in {path}", repr(scale), remedy)
    return float(scale)
