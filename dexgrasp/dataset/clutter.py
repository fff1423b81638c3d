"""Objects become scenes: placed on the table, settled, with the grasps that are still free to be carried out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull
from torch import Tensor

from dexgrasp.clearance import above_table, clear_way
from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import Object, ObjectSet
from dexgrasp.scene import Boxes, Scene, no_boxes
from dexgrasp.seeds import stream
from dexgrasp.simulation.simulator import Simulator


@dataclass(frozen=True)
class Clutter:
    """How scenes are laid out. Metres."""

    counts: tuple[int, ...] = (1, 2, 3, 4, 4, 5, 5, 5, 6, 7)
    """Numbers of objects, one of which is drawn."""
    extent: float = 0.12
    """Half the side of the square in which objects' origins are placed; it grows where there is no room."""
    gap: float = 0.005
    """Least distance between the footprints' convex hulls before settling."""
    tries: int = 30
    """Places tried for an object before the square grows by a tenth."""
    reach: float = 0.20
    """Objects whose centre of mass comes to rest farther from the middle (along x or y) are taken away."""


@dataclass(frozen=True)
class Approach:
    """What must be free for a grasp to count as feasible. Metres, radians."""

    retreat: float = 0.10
    """Length of the straight approach, see `dexgrasp.execution.pregrasp`."""
    opening: float = 0.35
    """By how much fingers are opened on the way."""
    table: float = 0.002
    """Least distance between hand and table."""
    neighbour: float = 0.002
    """Least distance between hand and the other objects."""
    own: float = 0.0005
    """Deepest overlap of the open hand with the object that it will grasp; touching is not yet moving it."""


def build_scene(objects: ObjectSet, clutter: Clutter, simulator: Simulator, seed: int, index: int) -> Scene:
    """Return scene `index` of a seed: random objects at rest in the middle of the table; at least one.

    Objects are drawn without repetition where the set is large enough, and stand in their stable poses as often as
    those are likely. What falls off or rolls away is left out.
    """
    for attempt in range(10):
        generator = stream(seed, "scene", index, attempt)
        count = int(generator.choice(clutter.counts))
        chosen = [objects[int(i)] for i in generator.choice(len(objects), count, replace=count > len(objects))]
        rest = simulator.settle(chosen, torch.from_numpy(place(chosen, clutter, generator)), seed).double()
        centres = [
            (pose @ torch.tensor([*item.com, 1.0], dtype=torch.float64))
            for pose, item in zip(rest, chosen, strict=True)
        ]
        kept = [i for i, centre in enumerate(centres) if bool((centre[:2].abs() < clutter.reach).all())]
        if kept:
            return Scene(tuple(chosen[i].name for i in kept), rest[kept], seed)
    raise RuntimeError(f"scene {index}: ten draws in a row left nothing on the table; is clutter.reach too small?")


def place(objects: Sequence[Object], clutter: Clutter, generator: np.random.Generator) -> Float[np.ndarray, "O 4 4"]:
    """Return random stable poses (world_T_object, 1 mm above the table) whose footprints keep apart."""
    poses: list[np.ndarray] = []
    footprints: list[np.ndarray] = []
    extent = clutter.extent
    for item in objects:
        stable, likelihood = item.stable
        pose = stable[generator.choice(len(stable), p=likelihood / likelihood.sum())]
        pose = _turn(generator.uniform(0, 2 * np.pi)) @ pose
        corners = (item.mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, :2]
        footprint = corners[ConvexHull(corners).vertices]
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


def separation(a: Float[np.ndarray, "A 2"], b: Float[np.ndarray, "B 2"]) -> float:
    """Return by how much two convex polygons (corners counter-clockwise, m) keep apart along their best edge normal.

    Negative where they overlap; never more than their distance.
    """
    best = -np.inf
    for one, other in ((a, b), (b, a)):
        edges = np.roll(one, -1, axis=0) - one
        outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-30
        clear = (other @ outward.T).min(axis=0) - (one * outward).sum(axis=1)
        best = max(best, float(clear.max()))
    return best


def approachable(
    shape: HandShape, hand: Hand, field: DistanceField, grasps: Grasps, approach: Approach
) -> Bool[Tensor, "N"]:
    """Tell which grasps of an object (its frame) can be reached when it is alone in the air.

    Neither the closed nor the opened hand collides with itself, and the opened hand does not meet the object on its
    straight way.
    """
    _, opened = pregrasp(hand, grasps, approach.retreat, approach.opening)
    free = ~shape.self_collision(grasps.joints) & ~shape.self_collision(opened)
    rows = free.nonzero().flatten()
    free[rows] = shape.approach_clear(field, grasps.pose[rows], opened[rows], approach.retreat, approach.own)
    return free


def feasible(
    shape: HandShape,
    hand: Hand,
    grasps: Grasps,
    poses: Float[Tensor, "O 4 4"],
    fields: Sequence[DistanceField],
    approach: Approach,
    fixtures: Boxes | None = None,
) -> Bool[Tensor, "N"]:
    """Tell which grasps (world frame, `object` counts the rows of `poses`) are clear of table, fixtures, neighbours.

    The closed hand at the grasp and the opened hand along the whole approach. `poses` is world_T_object; own object
    and self-collision are `approachable`'s matter, and synthesis has seen to them.
    """
    _, opened = pregrasp(hand, grasps, approach.retreat, approach.opening)
    free = torch.ones(len(grasps), dtype=torch.bool)
    ends = ((opened, approach.retreat), (grasps.joints, 0.0))
    for joints, way in ends:
        rows = free.nonzero().flatten()
        free[rows] = above_table(shape, grasps.pose[rows], joints[rows], way, approach.table)
    for joints, way in ends:
        rows = free.nonzero().flatten()
        obstacles = grasps.object[rows], poses, fields, fixtures or no_boxes()
        free[rows] = clear_way(shape, grasps.pose[rows], joints[rows], way, approach.neighbour, *obstacles)
    return free


def clear(
    shape: HandShape,
    hand: Hand,
    grasps: Grasps,
    poses: Float[Tensor, "O 4 4"],
    fields: Sequence[DistanceField],
    approach: Approach,
    fixtures: Boxes | None = None,
) -> Bool[Tensor, "N"]:
    """Tell which grasps are `feasible` in the scene and `approachable` on their own object (world frame)."""
    free = feasible(shape, hand, grasps, poses, fields, approach, fixtures)
    for number, field in enumerate(fields):
        rows = (free & (grasps.object == number)).nonzero().flatten()
        own = grasps[rows].moved(inverse(poses[number]))
        free[rows] = approachable(shape, hand, field, own, approach)
    return free


def _turn(angle: float) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose
