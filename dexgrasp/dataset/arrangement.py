"""Objects become scenes: scattered on the table, packed, piled or thrown into a bin, and settled."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.objects import Object, ObjectSet
from dexgrasp.scene import Boxes, Scene, no_boxes
from dexgrasp.seeds import stream
from dexgrasp.simulation.simulator import Simulator

ARRANGEMENTS = ("table", "packed", "pile", "bin")
DROP = 0.01
"""Height above everything else from which objects are dropped, m."""


@dataclass(frozen=True)
class Clutter:
    """How scenes are laid out. Metres."""

    counts: tuple[int, ...] = (1, 2, 3, 4, 4, 5, 5, 5, 6, 7)
    """Numbers of objects, one of which is drawn."""
    arrangement: str | Mapping[str, float] = "table"
    """One of `ARRANGEMENTS`, or several with their weights.

    `table`: apart, in stable poses. `packed`: the same, moved together until `gap` is left. `pile`: dropped one after
    another on the middle of the table, turned anyhow. `bin`: dropped between walls, which stay.
    """
    extent: float = 0.12
    """Half the side of the square in which objects' origins are placed; it grows where there is no room."""
    gap: float = 0.005
    """Least distance between the footprints' convex hulls before settling."""
    tries: int = 30
    """Places tried for an object before the square grows by a tenth."""
    reach: float = 0.20
    """Objects whose centre of mass comes to rest farther from the middle (along x or y) are taken away."""
    pile: float = 0.025
    """Standard deviation of where objects are dropped on a pile."""
    bin: tuple[float, float, float] = (0.30, 0.24, 0.08)
    """Length, width and height of the inside of a bin; how it is turned is drawn."""
    wall: float = 0.004
    """Thickness of a bin's walls."""

    def __post_init__(self) -> None:
        weights = self.weights
        if not weights or set(weights) - set(ARRANGEMENTS) or min(weights.values()) < 0 or sum(weights.values()) <= 0:
            expected = f"scenes.arrangement to be one of {', '.join(ARRANGEMENTS)}, or several with weights"
            raise DexgraspError(expected, repr(self.arrangement), "such as {table: 1, pile: 2}")
        if min(self.bin) <= 0 or self.wall <= 0:
            raise DexgraspError("scenes.bin and scenes.wall above 0", f"{self.bin}, {self.wall}", "set them so, m")

    @property
    def weights(self) -> dict[str, float]:
        """How often each arrangement is drawn."""
        return {self.arrangement: 1.0} if isinstance(self.arrangement, str) else dict(self.arrangement)


def build_scene(objects: ObjectSet, clutter: Clutter, simulator: Simulator, seed: int, index: int) -> Scene:
    """Return scene `index` of a seed: random objects at rest in the middle of the table; at least one.

    Objects are drawn without repetition where the set is large enough, and stand in their stable poses as often as
    those are likely, but where they are dropped. What falls off or rolls away is left out; where something does not
    come to rest, the scene is drawn anew.
    """
    for attempt in range(10):
        generator = stream(seed, "scene", index, attempt)
        count = int(generator.choice(clutter.counts))
        chosen = [objects[int(i)] for i in generator.choice(len(objects), count, replace=count > len(objects))]
        kinds = clutter.weights
        shares = np.array(list(kinds.values())) / sum(kinds.values())
        kind = next(iter(kinds)) if len(kinds) == 1 else str(generator.choice(list(kinds), p=shares))
        fixtures = bin_walls(clutter, generator.uniform(0, 2 * np.pi)) if kind == "bin" else no_boxes()
        if kind in ("pile", "bin"):
            rest = drop(chosen, clutter, simulator, fixtures, generator, seed)
        else:
            start = place(chosen, clutter, generator) if kind == "table" else pack(chosen, clutter, generator)
            rest = simulator.settle(chosen, torch.from_numpy(start), seed, fixtures).double()
        away = ~_inside(rest, chosen, clutter.reach)
        if bool((away & torch.isfinite(rest[:, 0, 3])).any()):  # others may have leant on it
            rest[away] = torch.nan
            rest = simulator.settle(chosen, rest, seed, fixtures).double()
        kept = (~away & torch.isfinite(rest[:, 0, 3])).tolist()
        if any(kept) and simulator.at_rest:
            names = tuple(item.name for item, there in zip(chosen, kept, strict=True) if there)
            return Scene(names, rest[torch.tensor(kept)], seed, fixtures)
    raise RuntimeError(f"scene {index}: ten draws in a row left nothing at rest; is clutter.reach too small?")


def _inside(poses: Float[Tensor, "O 4 4"], objects: Sequence[Object], reach: float) -> Tensor:
    """Tell which centres of mass lie in the middle of the table; those of objects that are gone do not."""
    centres = torch.stack(
        [pose[:3, :3] @ torch.from_numpy(item.com) + pose[:3, 3] for pose, item in zip(poses, objects, strict=True)]
    )
    return (centres[:, :2].abs() < reach).all(dim=1)


def place(objects: Sequence[Object], clutter: Clutter, generator: np.random.Generator) -> Float[np.ndarray, "O 4 4"]:
    """Return random stable poses (world_T_object, 1 mm above the table) whose footprints keep apart."""
    poses: list[np.ndarray] = []
    footprints: list[np.ndarray] = []
    extent = clutter.extent
    for item in objects:
        pose, footprint = _stand(item, generator)
        tried = 0
        while True:
            shift = generator.uniform(-extent, extent, 2)
            if all(separation(footprint + shift, other) > clutter.gap for other in footprints):
                break
            tried += 1
            if tried % clutter.tries == 0:
                extent *= 1.1
        pose[:3, 3] += [*shift, 0.001]
        poses.append(pose)
        footprints.append(footprint + shift)
    return np.stack(poses)


def pack(objects: Sequence[Object], clutter: Clutter, generator: np.random.Generator) -> Float[np.ndarray, "O 4 4"]:
    """Return random stable poses (world_T_object, 1 mm above the table) as close to each other as `gap` allows.

    Each object moves towards the middle, from the one of eight directions from which it comes nearest.
    """
    poses: list[np.ndarray] = []
    footprints: list[np.ndarray] = []
    for item in objects:
        pose, footprint = _stand(item, generator)
        best = np.full(2, np.inf)
        for angle in generator.uniform(0, 2 * np.pi, 8):
            direction = np.array([math.cos(angle), math.sin(angle)])
            way = 0.0
            while gaps := [separation(footprint + way * direction, other) for other in footprints]:
                if min(gaps) >= clutter.gap:
                    break
                way += max(clutter.gap - min(gaps), 1e-3) / 2
            if way < np.linalg.norm(best):
                best = way * direction
        poses.append(pose)
        footprints.append(footprint + best)
        pose[:3, 3] += [*best, 0.001]
    middle = (np.concatenate(footprints).min(axis=0) + np.concatenate(footprints).max(axis=0)) / 2
    for pose in poses:
        pose[:2, 3] -= middle
    return np.stack(poses)


def drop(
    objects: Sequence[Object],
    clutter: Clutter,
    simulator: Simulator,
    fixtures: Boxes,
    generator: np.random.Generator,
    seed: int,
) -> Float[Tensor, "O 4 4"]:
    """Drop objects one after another, turned anyhow, each from just above all that lies there; return where they rest.

    Between walls, those of a bin, they are dropped where they fit; else about the middle of the table.
    """
    poses = torch.full((len(objects), 4, 4), torch.nan, dtype=torch.float64)
    turn = fixtures.poses[0, :2, :2].numpy() if len(fixtures) else np.eye(2)
    for number, item in enumerate(objects):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=generator).as_matrix()
        corners = hull(item) @ pose[:3, :3].T
        if len(fixtures):
            local = corners[:, :2] @ turn
            low, high = local.min(axis=0), local.max(axis=0)
            half = np.array(clutter.bin[:2]) / 2
            room = np.maximum(half - (high - low) / 2 - DROP / 2, 0)
            shift = turn @ (generator.uniform(-room, room) - (low + high) / 2)
        else:
            shift = generator.normal(0, clutter.pile, 2) - (corners[:, :2].min(axis=0) + corners[:, :2].max(axis=0)) / 2
        tops = [(hull(objects[i]) @ poses[i, 2, :3].numpy()).max() + float(poses[i, 2, 3]) for i in range(number)]
        top = max([top for top in tops if math.isfinite(top)], default=0.0)
        pose[:3, 3] = [*shift, top + DROP - corners[:, 2].min()]
        poses[number] = torch.from_numpy(pose)
        poses = simulator.settle(objects, poses, seed, fixtures).double()
    return poses


def bin_walls(clutter: Clutter, angle: float) -> Boxes:
    """Return the four walls of a bin about the middle of the table, turned by `angle` (rad)."""
    length, width, height = clutter.bin
    thick = clutter.wall
    turn = _turn(angle)
    poses, halves = [], []
    for x, y, half in (
        ((length + thick) / 2, 0.0, (thick, width + 2 * thick, height)),
        (-(length + thick) / 2, 0.0, (thick, width + 2 * thick, height)),
        (0.0, (width + thick) / 2, (length, thick, height)),
        (0.0, -(width + thick) / 2, (length, thick, height)),
    ):
        pose = np.eye(4)
        pose[:3, 3] = x, y, height / 2
        poses.append(turn @ pose)
        halves.append(np.array(half) / 2)
    return Boxes(torch.from_numpy(np.stack(poses)), torch.from_numpy(np.stack(halves)))


@lru_cache(1024)
def hull(item: Object) -> Float[np.ndarray, "H 3"]:
    """Return the corners of an object's convex hull (object frame, m)."""
    vertices = np.asarray(item.mesh.vertices)
    return vertices[ConvexHull(vertices).vertices]


def _stand(item: Object, generator: np.random.Generator) -> tuple[NDArray, Float[np.ndarray, "C 2"]]:
    """Return a stable pose, as likely as it is, turned about the vertical, and its footprint's convex hull."""
    stable, likelihood = item.stable
    pose = stable[generator.choice(len(stable), p=likelihood / likelihood.sum())]
    pose = _turn(generator.uniform(0, 2 * np.pi)) @ pose
    corners = (hull(item) @ pose[:3, :3].T + pose[:3, 3])[:, :2]
    return pose, corners[ConvexHull(corners).vertices]


@numba.njit(cache=True)
def separation(a: NDArray, b: NDArray) -> float:
    """Return by how much two convex polygons (C, 2), corners counter-clockwise, m, keep apart.

    Along their best edge normal: negative where they overlap, never more than their distance.
    """
    best = -np.inf
    for turn in range(2):
        one, other = (a, b) if turn == 0 else (b, a)
        for i in range(len(one)):
            j = (i + 1) % len(one)
            x, y = one[j, 1] - one[i, 1], one[i, 0] - one[j, 0]
            length = math.sqrt(x * x + y * y) + 1e-30
            least = np.inf
            for k in range(len(other)):
                least = min(least, (other[k, 0] - one[i, 0]) * x + (other[k, 1] - one[i, 1]) * y)
            best = max(best, least / length)
    return best


def _turn(angle: float) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose
