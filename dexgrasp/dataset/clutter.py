"""Which grasps of a scene's objects can be carried out there."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.clearance import above_table, clear_way
from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.scene import Boxes, no_boxes


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
