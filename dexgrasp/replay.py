"""What an evaluation keeps so that its attempts can be seen again: replay.safetensors and dataset.json."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dexgrasp.checkpoint import replace_file
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.evaluation import Episode
from dexgrasp.geometry import transform
from dexgrasp.grasps import Grasps

FILE, DATASET = "replay.safetensors", "dataset.json"


@dataclass(frozen=True, eq=False)
class Strip:
    """One executed grasp and what was there before it."""

    scene: int
    number: int
    """Of the attempt in its scene."""
    poses: Float[Tensor, "O 4 4"]
    """world_T_object, m; NaN: gone."""
    grasp: Grasps
    """World frame."""
    offered: Grasps
    """All that were there to choose from, best first, world frame."""
    points: Float[Tensor, "P 3"]
    """What the camera saw, world frame, m, rounded to 0.1 mm."""
    instance: Int[Tensor, "P"]
    """True object of each point, -1: none."""
    world_T_camera: Float[Tensor, "4 4"]


def write_replay(folder: Path, episodes: Sequence[Episode], dataset: Dataset) -> Path:
    """Write the attempts of the scenes that are drawn, and where their dataset lies; about 70 KB an attempt."""
    tensors: dict[str, Tensor] = {}
    for episode in episodes:
        drawn = [attempt for attempt in episode.attempts if attempt.score is not None]
        for attempt, strip in zip(drawn, episode.strips, strict=False):
            key, view = f"{episode.scene}/{attempt.number}", strip["view"]
            tensors[f"{key}/poses"] = strip["poses"].double()
            for kind in ("grasp", "offered"):
                tensors |= {f"{key}/{kind}/{name}": value for name, value in strip[kind].tensors().items()}
            tensors[f"{key}/points"] = transform(view.world_T_camera.expand(len(view), 4, 4), view.points).half()
            tensors[f"{key}/instance"] = view.instance.to(torch.int16)
            tensors[f"{key}/world_T_camera"] = view.world_T_camera
    path = folder / FILE
    replace_file(path, save({name: value.clone().contiguous() for name, value in tensors.items()}))
    dataset.save(folder / DATASET)
    return path


def read_replay(folder: Path) -> list[Strip]:
    """Return the attempts that `write_replay` kept; raises DexgraspError where there are none."""
    path = folder / FILE
    if not path.is_file():
        remedy = "evaluate again with this version and evaluation.drawn above 0"
        raise DexgraspError(f"attempts to look at, {FILE}", f"none in {folder}", remedy)
    try:
        tensors = load(path.read_bytes())
        found = sorted({(int(scene), int(number)) for scene, number, *_ in (key.split("/") for key in tensors)})
        return [_strip(scene, number, tensors) for scene, number in found]
    except (SafetensorError, KeyError, ValueError, TypeError, OSError) as error:
        raise DexgraspError(f"a readable {path}", f"{type(error).__name__}: {error}", "evaluate again") from error


def _strip(scene: int, number: int, tensors: dict[str, Tensor]) -> Strip:
    key = f"{scene}/{number}"
    grasp, offered = (
        Grasps(**{each.name: tensors[f"{key}/{kind}/{each.name}"] for each in fields(Grasps)})
        for kind in ("grasp", "offered")
    )
    points, instance = tensors[f"{key}/points"].float(), tensors[f"{key}/instance"].long()
    poses, camera = tensors[f"{key}/poses"], tensors[f"{key}/world_T_camera"]
    return Strip(scene, number, poses, grasp, offered, points, instance, camera)
