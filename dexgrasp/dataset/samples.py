"""What a training step reads: clouds, sampling plans and targets at the seeds, as memory-mapped arrays."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.backbone import Backbone, Plan
from dexgrasp.dataset.claims import lock
from dexgrasp.errors import DexgraspError, room
from dexgrasp.progress import track
from dexgrasp.representation import Targets

TARGETS = tuple(Targets.__dataclass_fields__)
Read = Callable[[int], tuple[Float[Tensor, "N 6"], Targets]]
"""Returns cloud and targets of a view."""


@dataclass(frozen=True)
class Batch:
    """B views, ready for `GraspNet`."""

    cloud: Float[Tensor, "B N 6"]
    """Positions (m, camera frame) and unit normals."""
    plan: Plan
    targets: Targets
    """Flattened over the B M seed points."""

    def to(self, device: torch.device) -> "Batch":
        plan = {key: value.to(device, non_blocking=True) for key, value in self.plan.items()}
        return Batch(self.cloud.to(device, non_blocking=True), plan, self.targets.to(device))


class Samples:
    """Views of one split, made once per dataset, backbone and representation.

    Arrays are memory maps, so that several training processes share one copy.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.arrays = {path.stem: np.load(path, mmap_mode="r") for path in sorted(folder.glob("*.npy"))}

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return Samples, (self.folder,)

    def __len__(self) -> int:
        return len(self.arrays["cloud"])

    def batch(self, indices: Sequence[int]) -> Batch:
        """Return the views `indices`, copied into memory."""
        return assembled(self.rows(indices))

    def rows(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Return all arrays of the views `indices`, copied into memory, as they are kept: see `assembled`."""
        return {key: torch.from_numpy(array[list(indices)]) for key, array in self.arrays.items()}

    @property
    def graspable(self) -> float:
        """Share of seed points that carry a label."""
        return float((self.arrays["target.finger"][:] > 0).mean())


def assembled(rows: Mapping[str, Tensor]) -> Batch:
    """Return the batch of some views' rows, where these lie."""
    plan = {key.removeprefix("plan."): value.long() for key, value in rows.items() if key.startswith("plan.")}
    targets = {name: rows[f"target.{name}"].flatten(0, 1) for name in TARGETS}
    targets["finger"] = targets["finger"].long()
    return Batch(rows["cloud"], plan, Targets(**targets))


def collect(
    views: Sequence[int],
    read: Read,
    backbone: Backbone,
    folder: Path,
    label: str,
) -> Samples:
    """Write the samples of some views into `folder`, or open them where they are there already.

    `read(view)` gives the cloud and the targets of its points. The folder appears whole or not at all.
    """
    if (folder / "done.json").is_file():
        return Samples(folder)
    if not views:
        raise DexgraspError("at least one view to train on", "none", "make a dataset with more scenes")
    with lock(folder):  # of several runs one collects, and the others find it done
        if not (folder / "done.json").is_file():
            with room("a training's samples", folder.parent):
                _write(views, read, backbone, folder, label)
    return Samples(folder)


def _write(views: Sequence[int], read: Read, backbone: Backbone, folder: Path, label: str) -> None:
    for stale in folder.parent.glob(f".{folder.name}-*"):  # of a run that was killed
        shutil.rmtree(stale, ignore_errors=True)
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        arrays: dict[str, np.ndarray] = {}
        for row, view in enumerate(track(views, label)):
            for key, value in _rows(*read(view), backbone).items():
                if key not in arrays:
                    path = work / f"{key}.npy"
                    shape = (len(views), *value.shape)
                    arrays[key] = np.lib.format.open_memmap(path, mode="w+", dtype=value.dtype, shape=shape)
                    with path.open("r+b") as file:  # a full disk is told now, not by a bus error when it is written
                        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
                arrays[key][row] = value
        for array in arrays.values():
            array.flush()  # type: ignore[attr-defined]
        (work / "done.json").write_text(json.dumps({"views": len(views)}))
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(work, folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _rows(cloud: Tensor, targets: Targets, backbone: Backbone) -> dict[str, np.ndarray]:
    plan = backbone.plan(cloud[:, :3])
    at_seeds = targets[plan["seeds"].long()]
    rows = {"cloud": cloud.float().numpy()}
    rows |= {f"plan.{key}": value.numpy().astype(np.int32) for key, value in plan.items()}
    rows |= {f"target.{name}": _compact(value) for name, value in at_seeds.tensors().items()}
    return rows


def _compact(value: Tensor) -> np.ndarray:
    if value.is_floating_point():
        return value.float().numpy()
    return value.numpy() if value.dtype == torch.bool else value.numpy().astype(np.int8)
