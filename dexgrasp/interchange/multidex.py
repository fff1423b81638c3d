"""Tensors as MultiDex has them (Li et al. 2023; D(R,O) Grasp): {metadata: [(q, object, robot), ...]} in a .pt file.

q is base position, rotation, joints. The rotation is three Euler angles about moving axes x, y, z (D(R,O)), or the
first two columns of the matrix (MultiDex), as the number of joints tells. A bare tensor (N, 6 + J or 9 + J) will do as
well. None of it names joints or units, so they have to be told.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import Array, GraspSet, Posture, posed
from dexgrasp.sensing.limits import sized


class MultiDex(Format):
    """Reads .pt and .pth; PyTorch's restricted loader makes tensors and plain containers only."""

    name = "multidex"
    summary = "MultiDex, D(R,O) Grasp: .pt of {metadata: [(q, object, robot)]} or a tensor; tell joints and units"

    def recognises(self, path: Path) -> bool:
        """Any file of PyTorch."""
        return path.is_file() and path.suffix in (".pt", ".pth")

    def read(self, path: Path, told: Told) -> GraspSet:
        """Joints and units have to be told; `hand` where the file holds several robots."""
        try:
            content = torch.load(sized(path), map_location="cpu", weights_only=True)
        except Exception as error:  # whatever is wrong in such a file, it is the file's fault
            found = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            raise DexgraspError(f"tensors and plain containers in {path}", found, "ask for plain data") from error
        rows = _rows(content, path, told)
        robots = sorted({robot for _, _, robot in rows})
        hand = told.robot or (robots[0] if len(robots) == 1 else "")
        if hand not in robots and not (told.robot and robots == [""]):
            remedy = "tell which: robot=NAME" + ("" if told.robot else " (the file holds several)")
            raise DexgraspError(f"a robot of {path}: {', '.join(robots)}", repr(told.robot), remedy)
        rows = [row for row in rows if row[2] in (hand, "")]
        length, angle = told.unit_factors(str(path))
        widths = {row[0].shape for row in rows}
        if len(widths) > 1:
            raise DexgraspError(f"grasps of {hand} of one length in {path}", f"{sorted(map(str, widths))}", "mend it")
        q = np.stack([row[0] for row in rows])
        joints = q.shape[1] - 6 if len(told.joints) == q.shape[1] - 6 else q.shape[1] - 9
        names = told.joints_of(joints, f"{hand or 'the hand'} in {path} (6 or 9 numbers of {q.shape[1]} are the base)")
        rotation = _euler(angle * q[:, 3:6]) if joints == q.shape[1] - 6 else _two_columns(q[:, 3:9], path)
        return GraspSet(
            hand=hand,
            joint_names=names,
            objects=tuple(name for _, name, _ in rows),
            grasp=Posture(posed(length * q[:, :3], rotation), angle * q[:, -joints:]),
            scale=np.full(len(rows), length if told.scale is None else told.scale),
            score=np.full(len(rows), np.nan),
        )


def _rows(content: Any, path: Path, told: Told) -> list[tuple[Array, str, str]]:
    """Return q, object and robot of each grasp."""
    entries = content.get("metadata") if isinstance(content, dict) else content
    if isinstance(entries, torch.Tensor):
        if entries.ndim != 2 or not told.object:
            found = f"shape {tuple(entries.shape)}, object {told.object!r}"
            remedy = "tell object=NAME; a tensor says nothing else"
            raise DexgraspError(f"a tensor (N, Q) in {path}, and the object's name", found, remedy)
        return [(row.double().numpy(), told.object, "") for row in entries]
    if not isinstance(entries, list | tuple) or not entries:
        raise DexgraspError(f"metadata [(q, object, robot), ...] in {path}", type(content).__name__, "check the format")
    rows = []
    for number, entry in enumerate(entries):
        parts = list(entry) if isinstance(entry, list | tuple) else []
        tensors = [part for part in parts if isinstance(part, torch.Tensor) and part.ndim == 1]
        texts = [part for part in parts if isinstance(part, str)]
        if not tensors or len(texts) != 2:
            kinds = [type(part).__name__ for part in parts]
            raise DexgraspError(f"(q, object, robot) as entry {number} of {path}", str(kinds), "check the format")
        rows.append((tensors[-1].double().numpy(), texts[0].rpartition("+")[2], texts[1]))
    return rows


def _euler(angles: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("XYZ", angles).as_matrix())


def _two_columns(numbers: Array, path: Path) -> Array:
    """Return rotations from their first two columns (Zhou et al. 2019), made orthonormal in order."""
    first, second = numbers[:, :3], numbers[:, 3:]
    size = np.linalg.norm(first, axis=1, keepdims=True)
    x = first / np.where(size > 0, size, 1)
    y = second - (x * second).sum(axis=1, keepdims=True) * x
    across = np.linalg.norm(y, axis=1, keepdims=True)
    if (size < 1e-3).any() or (across < 1e-3).any():
        raise DexgraspError(f"two columns of a rotation in q[3:9] of {path}", "parallel or zero", "mend the file")
    y = y / across
    return np.stack([x, y, np.cross(x, y)], axis=2)
