"""What is learnt from: objects as they were seen, and the grasps of each that are feasible there."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.level import carried
from dexgrasp.progress import track
from dexgrasp.seeds import stream
from dexgrasp_multifingan.networks import UNIT

LEAST = 30
"""Points of an object that must be seen."""
GRASPS = 200
"""Most grasps of an object in a view."""


@dataclass(frozen=True)
class Example:
    """One object in one view. Object frame: world axes (z up), origin in the middle of what is seen, m, float32."""

    cloud: Float[Tensor, "P 7"]
    object: int
    """In the dataset's objects."""
    frame_T_object: Float[Tensor, "4 4"]
    height: float
    """Of the frame's origin above the table."""
    base: Float[Tensor, "G 4 4"]
    joints: Float[Tensor, "G J"]
    touching: Bool[Tensor, "G F"]


def seen_object(cloud: Float[Tensor, "N 6"], count: int, seed: int, row: int) -> tuple[Tensor, Tensor]:
    """Return `count` points of an object's level cloud (m, z above the table) as the networks see them, and its middle.

    The middle is that of the smallest upright box about the cloud: it depends little on where points are dense.
    """
    points = cloud[:, :3]
    middle = (points.amin(0) + points.amax(0)) / 2
    rng = stream(seed, "points", row)
    chosen = torch.from_numpy(rng.choice(len(cloud), count, replace=len(cloud) < count))
    some = cloud[chosen]
    around = (some[:, :3] - middle) / UNIT
    return torch.cat([around, some[:, 3:], some[:, 2:3] / UNIT], dim=1).float(), middle


def examples(dataset: Dataset, points: int, most: int, seed: int) -> list[Example]:
    """Return the examples of at most `most` views of split "train"; raises DexgraspError where there is none."""
    views = list(dataset.split("train"))
    drawn = sorted(stream(seed, "views").permutation(len(views))[:most].tolist())
    found = [example for view in track(drawn, "examples") for example in _of_view(dataset, views[view], points, seed)]
    if not found:
        raise DexgraspError("objects that are seen and can be grasped", "none in split train", "make more scenes")
    return found


def _of_view(dataset: Dataset, index: int, points: int, seed: int) -> Iterator[Example]:
    view, scene = dataset.view(index), dataset.scene_of(index)
    cloud = carried(torch.cat([view.points, view.normals], dim=1), view.world_T_camera)
    poses, grasps = dataset.scene(scene).poses, dataset.scene_grasps(scene)
    for row, number in enumerate(dataset.scene_objects(scene).tolist()):
        own = grasps[grasps.object == row]
        told = cloud[view.instance == row]
        if len(told) < LEAST or not len(own):
            continue
        own = own[torch.from_numpy(stream(seed, "grasps", index, row).permutation(len(own))[:GRASPS])]
        seen, middle = seen_object(told, points, seed + index, row)
        away = torch.eye(4, dtype=torch.float64)
        away[:3, 3] = middle
        frame_T_world = inverse(away)
        yield Example(
            seen,
            number,
            (frame_T_world @ poses[row].double()).float(),
            float(middle[2]),
            (frame_T_world @ own.pose.double()).float(),
            own.joints.float(),
            own.touching,
        )
