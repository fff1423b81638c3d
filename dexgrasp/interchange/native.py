"""Our own grasps: a dataset's, and sets of grasps as safetensors."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import GraspSet, Posture
from dexgrasp.sensing.limits import head, sized

SCHEMA = "dexgrasp.grasps/1"
ARRAYS = ("scale", "score", "world_T_object", "touching")
STAGES = ("grasp", "pregrasp", "squeeze")


class Native(Format):
    """Reads and writes every field of a `GraspSet`; the header is JSON and says the units."""

    name = "dexgrasp"
    summary = "ours: .safetensors with everything that can be told of a grasp"

    def recognises(self, path: Path) -> bool:
        """By the header's schema."""
        return path.is_file() and path.suffix == ".safetensors" and SCHEMA.encode() in head(path, 100_000)

    def read(self, path: Path, told: Told) -> GraspSet:
        """Nothing has to be told."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(sized(path), "np") as file:
                header = json.loads((file.metadata() or {})["dexgrasp"])
                arrays = {key: file.get_tensor(key).astype(np.float64) for key in file.keys()}  # noqa: SIM118
            if header["schema"] != SCHEMA or header["units"] != ["m", "rad"]:
                raise DexgraspError(f"{SCHEMA} in m and rad in {path}", str(header)[:100], "convert it anew")
            stages: dict[str, Any] = {
                stage: Posture(arrays[f"{stage}.pose"], arrays[f"{stage}.joints"])
                for stage in STAGES
                if f"{stage}.pose" in arrays
            }
            given: dict[str, Any] = {key: arrays[key] for key in ARRAYS if key in arrays}
            if "touching" in given:
                given["touching"] = given["touching"] > 0
            texts: dict[str, Any] = {key: tuple(header[key]) for key in ("joint_names", "objects", "names")}
            return GraspSet(hand=header["hand"], **texts, **given, **stages)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise DexgraspError(
                f"a grasp file {path}", f"{type(error).__name__}: {error}", "convert it anew"
            ) from error

    def write(self, grasps: GraspSet, path: Path) -> Path:
        """Write one file."""
        from safetensors.numpy import save_file

        arrays: dict[str, Any] = {key: value for key in ARRAYS if (value := getattr(grasps, key)) is not None}
        for stage in STAGES:
            posture = getattr(grasps, stage)
            if posture is not None:
                arrays |= {f"{stage}.pose": posture.pose, f"{stage}.joints": posture.joints}
        header = {"schema": SCHEMA, "units": ["m", "rad"], "hand": grasps.hand}
        header |= {key: list(getattr(grasps, key)) for key in ("joint_names", "objects", "names")}
        path.parent.mkdir(parents=True, exist_ok=True)
        plain = {key: np.ascontiguousarray(value, dtype=np.float64) for key, value in arrays.items()}
        save_file(plain, path, {"dexgrasp": json.dumps(header)})
        return path


class DatasetGrasps(Format):
    """Reads the grasps of a dataset that `dataset` made."""

    name = "dataset"
    summary = "ours: a dataset's description or folder; its grasps, with its objects"

    def recognises(self, path: Path) -> bool:
        """Whatever `Dataset.open` opens."""
        from dexgrasp.dataset.dataset import Dataset

        if path.is_file() and path.suffix != ".json":
            return False
        try:
            return "grasps" in Dataset.open(path).folders
        except (DexgraspError, OSError):
            return False

    def read(self, path: Path, told: Told) -> GraspSet:
        """All grasps of all objects; score is epsilon, or that of the file's maker."""
        from dexgrasp.dataset.dataset import Dataset

        dataset = Dataset.open(path)
        names = [item["name"] for item in dataset.store("objects").facts()]
        parts = [dataset.grasps(number) for number in range(len(names))]
        owners = tuple(name for name, part in zip(names, parts, strict=True) for _ in range(len(part)))
        pose, joints, quality = (
            np.concatenate([getattr(part, key).double().numpy() for part in parts])
            for key in ("pose", "joints", "quality")
        )
        return GraspSet(
            hand=str(dataset.hand_config["name"]),
            joint_names=tuple(dataset.hand.joint_names),
            objects=owners,
            grasp=Posture(pose, joints),
            scale=np.ones(len(pose)),
            score=quality,
            touching=np.concatenate([part.touching.numpy() for part in parts]),
        )
