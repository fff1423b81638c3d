"""Which of a network's grasps are offered: free of what the camera saw, clear of the table, and different."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.cloud_depth import Blocks, in_blocks
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.set_up import above, upright


@dataclass(frozen=True)
class Selection:
    """`conf/selection`. Lengths in metres, angles in radians."""

    min_score: float = 0.0
    """Grasps that score less are never offered."""
    candidates: int = 1024
    """Only so many of the best are looked at."""
    depth: float | None = 0.003
    """How deep an observed point may lie in the open hand; None: the cloud is not looked at.

    On 8 scenes of five shapes seen by a noisy D435: 100 % of the feasible grasps pass at 2 to 10 mm, and 3 % of the
    infeasible ones at 3 mm (11 % at 10 mm); most of these meet what the camera does not see."""
    table: float | None = 0.001
    """How far the hand may reach below the table that is found in the cloud; None: no table is looked for."""
    upright: float | None = None
    """A hand that comes down on the table this steeply is turned to come straight down; 0: none is.

    None, here and in the next: as the network's scorer was taught, `GraspNet.selecting`; 0 without one."""
    raised: float | None = None
    """A hand that reaches into the table by less than this is raised until it clears it by `gap`; 0: none is."""
    gap: float = 0.0005
    retreat: float = 0.10
    """Length of the straight approach that must be free."""
    opening: float = 0.35
    """How much the closing joints are opened for the approach (rad, or m where prismatic)."""
    steps: int = 3
    """Places along the approach that are checked, the grasp's own included."""
    distance: float = 0.02
    """Of two grasps nearer than this and than `angle`, the worse is dropped."""
    angle: float = 0.35


def select(
    hand: Hand,
    grasps: Grasps,
    cloud: Float[Tensor, "N 6"],
    top_k: int,
    selection: Selection,
    table_T_camera: Float[Tensor, "4 4"] | None,
) -> Grasps:
    """Return at most `top_k` grasps (of `cloud`'s frame, the camera's), best first.

    `table_T_camera` is the table in the cloud, None where none is seen.
    Candidates are taken in the order of their score and checked lazily, so that good ones cost little.
    """
    good = grasps.pose.flatten(1).isfinite().all(1) & grasps.joints.isfinite().all(1)
    good &= grasps.quality >= selection.min_score
    order = torch.argsort(torch.where(good, grasps.quality, -torch.inf), descending=True, stable=True)
    grasps = grasps[order[: min(int(good.sum()), selection.candidates)]]
    shape = _shape(hand) if selection.depth is not None or selection.table is not None else None
    table = table_T_camera if selection.table is not None else None
    points = in_blocks(cloud[:, :3])
    kept: list[int] = []
    for start, stop in _chunks(len(grasps), top_k):
        if len(kept) >= top_k:
            break
        some = grasps[start:stop]
        if shape is not None and table is not None:
            some = on_table(hand, shape, some, table, selection)
            grasps.pose[start:stop] = some.pose
        fresh = (~_alike(some.pose, grasps.pose[kept], selection).any(dim=1)).nonzero().flatten()
        if shape is not None and len(fresh):
            fresh = fresh[free(hand, shape, some[fresh], points, table, selection)]
        pose = some.pose[fresh]
        like, chosen = _alike(pose, pose, selection).numpy(), list[int]()
        for row in range(len(fresh)):
            if len(kept) + len(chosen) < top_k and not like[row, chosen].any():
                chosen.append(row)
        kept += (start + fresh[chosen]).tolist()
    return grasps[kept]


def on_table(hand: Hand, shape: Any, grasps: Grasps, table: Float[Tensor, "4 4"], selection: Selection) -> Grasps:
    """Return the grasps as they are carried out above a table, see `dexgrasp.set_up`; `table` is table_T_camera."""
    if selection.upright:
        grasps = upright(hand, grasps, table, selection.upright)
    if selection.raised:
        grasps = above(hand, shape, grasps, table, selection.raised, selection.gap, selection.opening)
    return grasps


def free(
    hand: Hand,
    shape: Any,
    grasps: Grasps,
    points: Float[Tensor, "P 3"] | Blocks,
    table: Float[Tensor, "4 4"] | None,
    selection: Selection,
) -> Bool[Tensor, "N"]:
    """Return whether each grasp and its straight approach are free of observed points and of the table.

    The fingers are open by `selection.opening`: they close until they touch, so where they end is no collision; but
    the table must be clear of the closed posture too. `shape` is the hand's `HandShape`, `table` is table_T_camera.
    """
    passed = torch.ones(len(grasps), dtype=torch.bool)
    points = points if isinstance(points, Blocks) else in_blocks(points)
    away, joints = pregrasp(hand, grasps, 1.0, selection.opening)
    steps = torch.linspace(0.0, selection.retreat, max(1, selection.steps)).to(away)
    way = grasps.pose + steps[:, None, None, None] * (away - grasps.pose)  # (steps, N, 4, 4): moved, not turned
    if table is not None and selection.table is not None:
        motion, both = table.to(away), torch.stack([grasps.joints, *[joints] * len(steps)])
        places = motion @ torch.cat([grasps.pose[None], way])
        height = torch.as_tensor(shape.table_distance(places.flatten(0, 1), both.flatten(0, 1)))
        passed &= (height.unflatten(0, places.shape[:2]) >= -selection.table).all(dim=0)
    if selection.depth is not None:
        # Most that meet something do so where they grasp: the rest of the way is looked at for the others only.
        for places in (way[:1], way[1:]):
            rows = passed.nonzero().flatten()
            tried, opened = places[:, rows].flatten(0, 1), joints[rows].repeat(len(places), 1)
            depth = torch.as_tensor(shape.cloud_depth(points, tried, opened, enough=selection.depth))
            passed[rows] = (depth.reshape(len(places), len(rows)) <= selection.depth).all(dim=0)
    return passed


def _chunks(total: int, top_k: int) -> Iterator[tuple[int, int]]:
    """Ranges over the candidates: first about as many as hold those wanted, of BarrettHand's, then ever more."""
    start, size = 0, max(16, 3 * top_k)
    while start < total:
        yield start, min(start + size, total)
        start, size = start + size, min(2 * size, 256)


def _alike(poses: Float[Tensor, "N 4 4"], others: Float[Tensor, "M 4 4"], selection: Selection) -> Bool[Tensor, "N M"]:
    """Return which of the hands are at nearly the same place as which of the others."""
    gap = poses[:, None, :3, 3] - others[None, :, :3, 3]
    alike = torch.linalg.vector_norm(gap, dim=-1) < selection.distance
    row, other = alike.nonzero().unbind(1)
    turned = rotation_angle(poses[row, :3, :3], others[other, :3, :3])
    alike[row, other] = turned < selection.angle
    return alike


@lru_cache(maxsize=4)
def _shape(hand: Hand) -> Any:
    from dexgrasp.collision import HandShape

    return HandShape(hand)
