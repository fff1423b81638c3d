"""Grasps of what was seen: object by object, clear of everything that was seen, fingers closed on the surface."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.cloud import prepare
from dexgrasp.collision import HandShape
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import closing_directions, pregrasp
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.level import carried, level_frame
from dexgrasp.model import GraspNet
from dexgrasp.selection import Selection, select
from dexgrasp.sight import Sight

WINDOW = 0.22
"""Half the side of the part of a scene that a network sees at once, m: about what it is trained on."""
TOGETHER = 0.12
"""Objects nearer than this (m, horizontally) to the middle of a window are grasped from it."""
NEAR = 0.05
"""Farthest that the middle of the fingertips may be from what was seen of their object, m."""
FEWEST = 40
"""Grasps that are closed on what was seen, at least: fewer wanted are the best of the same."""
CLOSER, OPENER, STEPS = 0.25, 0.5, 26
"""Fingers are closed on what was seen: so far beyond and before the predicted joints (rad or m), in so many steps."""
TOUCH = 0.001
"""Depth (m) of an observed point in the hand that is a contact."""
BEHIND = 0.06
"""Farthest that a finger which touches may end from what was seen of its object, m: the far side is not seen."""
PAD = 0.008
"""Farthest that a point may be from the fingertip's surface to be its contact, m."""


@dataclass(frozen=True, eq=False)
class Predicted:
    """Grasps, best first, in the frame of the first camera; `Grasps.object` counts the objects of `sight`."""

    grasps: Grasps
    """`contacts` and `normals` are those with what was seen; NaN where a finger meets nothing that was."""
    pregrasp_pose: Float[Tensor, "N 4 4"]
    pregrasp_joints: Float[Tensor, "N J"]
    sight: Sight

    def ranked(self, order: Int[Tensor, "N"]) -> "Predicted":
        """Return the same grasps in another order."""
        return replace(
            self,
            grasps=self.grasps[order],
            pregrasp_pose=self.pregrasp_pose[order],
            pregrasp_joints=self.pregrasp_joints[order],
        )


def predict_sight(
    model: GraspNet,
    sight: Sight,
    top_k: int = 20,
    selection: Selection | None = None,
    target: int | None = None,
    seed: int = 0,
) -> Predicted:
    """Return at most `top_k` grasps of the objects in sight, or of one of them.

    Raises DexgraspError where nothing stands out of the table, or there is no such object.
    """
    if sight.objects == 0:
        raise DexgraspError(
            "objects that stand out of the table",
            "none: nothing higher than 8 mm hangs together",
            "move the camera nearer, or mark the object: mask=FILE",
        )
    if target is not None and not 0 <= target < sight.objects:
        raise DexgraspError(
            f"an object from 0 to {sight.objects - 1}", str(target), "see the picture for their numbers"
        )
    chosen = model.selecting(selection)
    cloud = torch.from_numpy(np.hstack([sight.points, sight.normals]))
    table = None if sight.table_T_camera is None else torch.from_numpy(sight.table_T_camera)
    level_T_camera = level_frame(cloud, table)
    level = carried(cloud, level_T_camera)
    parts = []
    for middle, members in _windows(level, sight.labels, target):
        inside = ((level[:, :2] - middle).abs() < WINDOW).all(1) & (level[:, 2] > -0.03)
        part = sight.points[inside.numpy()], sight.normals[inside.numpy()]
        seen = prepare(part[0], part[1], model.points, seed, outward=True)
        device = next(model.parameters()).device
        grasps = model.propose(carried(seen, level_T_camera).to(device)).to("cpu")
        grasps = _owned(model.hand, grasps.moved(inverse(level_T_camera)), sight)
        parts.append(grasps[torch.isin(grasps.object, torch.tensor(members))])
    grasps = Grasps.cat(parts)
    # Only what a hand can reach from an object matters; the rest of a room costs time.
    near = _beside(level, sight.labels)
    clear = select(model.hand, grasps, cloud[near], max(2 * top_k, FEWEST), chosen, table)
    closed = close_on(model.hand, clear, sight)
    shape = HandShape(model.hand)
    depth = shape.cloud_depth(cloud[near, :3], closed.pose.double(), closed.joints.double())
    good = depth <= (chosen.depth if chosen.depth is not None else torch.inf)
    good &= _at_object(model.hand, closed, sight)
    if table is not None and chosen.table is not None:
        good &= shape.table_distance(table @ closed.pose.double(), closed.joints.double()) >= -chosen.table
    closed = closed[good][:top_k]
    pose, joints = pregrasp(model.hand, closed, chosen.retreat, chosen.opening)
    return Predicted(closed, pose, joints, sight)


def _windows(
    level: Float[Tensor, "P 6"], labels: NDArray[np.int64], target: int | None
) -> list[tuple[Tensor, list[int]]]:
    """Return middles (2,) and the objects that are grasped from each window; the level frame's x and y, m."""
    wanted = [target] if target is not None else list(range(int(labels.max()) + 1))
    middles = {k: level[torch.from_numpy(labels == k), :2].median(dim=0).values for k in wanted if (labels == k).any()}
    found = []
    while middles:
        middle = next(iter(middles.values()))
        members = [k for k, place in middles.items() if float((place - middle).norm()) < TOGETHER]
        found.append((torch.stack([middles.pop(k) for k in members]).mean(dim=0), members))
    return found


def _owned(hand: Hand, grasps: Grasps, sight: Sight) -> Grasps:
    """Return the grasps with the object that lies between their fingertips; -1 where none does."""
    some = np.flatnonzero(sight.labels >= 0)
    middle = _tips(hand, grasps.pose.double(), grasps.joints.double()).mean(dim=1).nan_to_num(1e6).numpy()
    distance, nearest = cKDTree(sight.points[some]).query(middle)
    owner = np.where(distance < NEAR, sight.labels[some][nearest], -1)
    return grasps.replace(object=torch.from_numpy(owner))


def _tips(hand: Hand, pose: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"]) -> Float[Tensor, "N F 3"]:
    return (pose[:, None] @ hand.fingertips(joints))[..., :3, 3]


def _at_object(hand: Hand, grasps: Grasps, sight: Sight) -> Tensor:
    """Tell which grasps touch what was seen, with no finger that touches far from their object."""
    tips = _tips(hand, grasps.pose.double(), grasps.joints.double())
    good = torch.ones(len(grasps), dtype=torch.bool)
    radii = torch.tensor([finger.tip_radius for finger in hand.fingers], dtype=torch.float64)
    for number in torch.unique(grasps.object).tolist():
        rows = grasps.object == number
        tree = cKDTree(sight.points[sight.labels == number])
        gaps = torch.from_numpy(tree.query(tips[rows].numpy())[0])
        touching = grasps.touching[rows]
        near = ((gaps < BEHIND) | ~touching).all(dim=1)
        good[rows] &= near & ((gaps - radii < PAD) & touching).any(dim=1)
    return good


def _beside(level: Float[Tensor, "P 6"], labels: NDArray[np.int64], reach: float = 0.35) -> Tensor:
    places = level[:, :2].numpy()
    some = cKDTree(places[labels >= 0][::7])
    return torch.from_numpy(np.isfinite(some.query(places, distance_upper_bound=reach)[0]))


def close_on(hand: Hand, grasps: Grasps, sight: Sight) -> Grasps:
    """Return grasps whose fingers close until they touch what was seen, with the contacts.

    A finger that meets nothing within a little more than its predicted closing is left as predicted: what it touches
    was not seen.
    """
    shape, joints = HandShape(hand), grasps.joints.double().clone()
    pose, count = grasps.pose.double(), len(grasps)
    near, sides = sight.points[sight.labels >= 0], sight.normals[sight.labels >= 0]
    # Each finger is tried with the others out of its way: where those end is another question.
    away = hand.clamp(joints - OPENER * closing_directions(hand, grasps.touching).to(joints))
    done = set[str]()
    for number, finger in enumerate(hand.fingers):
        own = [name for name in finger.closing if name not in done]
        done |= set(own)
        if not own or count == 0:
            continue
        places = hand.joint_index(tuple(own))
        rates = torch.tensor([finger.closing[name] for name in own], dtype=torch.float64)
        way = torch.linspace(-OPENER, CLOSER, STEPS, dtype=torch.float64)
        tried = away[:, None].repeat(1, STEPS, 1)
        tried[..., places] = joints[:, None, places] + way[:, None] * rates
        tried = hand.clamp(tried.flatten(0, 1))
        depth = shape.cloud_depth(torch.from_numpy(near), pose.repeat_interleave(STEPS, dim=0), tried)
        depth = depth.reshape(count, STEPS)
        hit = depth > depth[:, :1] + TOUCH
        step = (hit.cumsum(dim=1) == 0).sum(dim=1) - 1  # the last before the first contact
        meets = hit.any(dim=1) & grasps.touching[:, number]
        at = tried.reshape(count, STEPS, -1)[torch.arange(count), step]
        joints[:, places] = torch.where(meets[:, None], at[:, places], joints[:, places])
    contacts = torch.full((count, len(hand.fingers), 3), torch.nan, dtype=torch.float64)
    normals = contacts.clone()
    tips = _tips(hand, pose, joints)
    tree = cKDTree(near)
    for number, finger in enumerate(hand.fingers):
        if len(grasps) == 0:
            break
        distance, nearest = tree.query(tips[:, number].numpy())
        on = torch.from_numpy(distance - finger.tip_radius < PAD) & grasps.touching[:, number]
        contacts[on, number] = torch.from_numpy(near[nearest])[on]
        normals[on, number] = torch.from_numpy(sides[nearest])[on]
    kind = grasps.pose.dtype
    return grasps.replace(joints=joints.to(kind), contacts=contacts.to(kind), normals=normals.to(kind))
