"""What is known of grasps without physics: quality of their contacts, depth, distance, diversity (METHOD section 5)."""

from collections.abc import Iterable
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.dataset.spread import coverage, direction_parts
from dexgrasp.dataset.surface import Surface
from dexgrasp.dataset.verdicts import metrics as contact_metrics
from dexgrasp.distance import DistanceField
from dexgrasp.execution import opened
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.seeds import stream
from dexgrasp.simulation.protocol import Physics
from dexgrasp.simulation.world import World
from dexgrasp.wrench_model import WrenchModel

FRICTION, EDGES = 0.5, 8
"""Of the contacts' cones; torques about the centre of mass over the largest radius."""
OPENING = 0.35
"""Fingers are opened by this and closed again to find their contacts, rad or m: as grasps are carried out."""
NEAR, FAR = 0.002, 0.01
"""A link within the one touches; a fingertip farther than the other counts as that far, m (as DexGraspBench has it)."""
LESS_IS_BETTER = ("penetration", "self_penetration", "contact_distance")
BINS, CELL = 100, 0.02
"""Of joints between their limits (as DexGraspNet has it), and of palm positions, m."""


def closed(hand: Hand, field: DistanceField, grasps: Grasps) -> Grasps:
    """Return grasps (object frame) with the contacts at which their fingers end, opened a little and closed again."""
    grasps = grasps.to(torch.float64)
    touching = grasps.touching
    start = opened(hand, grasps.joints, OPENING, touching)
    closure = Closer(hand).close(field, grasps.pose, start, centred=True, touching=touching)
    return grasps.replace(contacts=closure.contacts, normals=closure.normals)


def grasp_metrics(
    hand: Hand, shape: HandShape, item: Object, field: DistanceField, grasps: Grasps, physics: Physics
) -> dict[str, Float[Tensor, "N"]]:
    """Return metrics of grasps (object frame) whose contacts are known (`closed`).

    Of contacts after closing: `epsilon`, `epsilon_linf`, `volume`, `spread` (m), `centred` (m). Of the posture as
    told: `penetration` (deepest point of the hand in the object, m), `self_penetration` (deepest overlap of two of its
    fingers, m), `contact_distance` (mean over links of the fingertips that
    are to touch, at most 1 cm, m), `contact_count` (links within 2 mm).
    """
    found = contact_metrics(grasps, WrenchModel.about(item, hand, FRICTION, EDGES))
    links = shape.link_distances(field, grasps.pose, grasps.joints)
    names = [record.name for record in hand.tree]  # type: ignore[attr-defined]
    tips = [names.index(finger.link) for finger in hand.fingers]
    return found | {
        "penetration": (-links.min(dim=1).values).clamp(min=0.0),
        "self_penetration": self_penetration(hand, grasps, physics),
        "contact_distance": links[:, tips].clamp(0.0, FAR).where(grasps.touching, torch.nan).nanmean(dim=1),
        "contact_count": (links.abs() < NEAR).double().sum(dim=1),
    }


def self_penetration(hand: Hand, grasps: Grasps, physics: Physics) -> Float[Tensor, "N"]:
    """Return how deep links of different fingers are in each other, m; neighbours and allowed contacts aside."""
    world = World([], hand, physics)
    depths = []
    for joints in hand.clamp(grasps.joints.double()).numpy():
        world.place_hand(np.eye(4), joints)
        depths.append(world.own_overlap())
    return torch.tensor(depths, dtype=torch.float64)


def diversity(hand: Hand, bodies: Iterable[tuple[Object, DistanceField, Grasps]], seed: int) -> dict[str, float]:
    """Return how different the grasps (object frame, `closed`) of a set are.

    `joint_entropy`: bits, mean over joints, of all grasps in 100 bins between the limits. `direction_entropy` and
    `position_entropy`: bits, mean over objects, of approach directions in 200 equal parts of the sphere and of palm
    positions in cells of 2 cm. All are at most log2 of the number of grasps: compare sets of one size.
    `surface_coverage` and `direction_coverage`: shares reached, mean over objects (`dataset.spread.coverage`).
    """
    limits = hand.limits.numpy()
    joints, directions, positions, surfaces, shares = [], [], [], [], []
    for item, field, grasps in bodies:
        palm = grasps.pose.double() @ hand.base_T_palm
        joints.append(grasps.joints.double().numpy())
        directions.append(_entropy(direction_parts(palm[:, :3, 2].numpy())))
        cells = np.floor(palm[:, :3, 3].numpy() / CELL).astype(np.int64)
        positions.append(_entropy(np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)))
        reached = coverage(hand, Surface.sample(item, field, 0.005, stream(seed, "coverage", item.name)), grasps)
        surfaces.append(reached.surface)
        shares.append(reached.directions)
    if not joints:
        return {}
    free = np.flatnonzero(limits[:, 1] > limits[:, 0])
    unit = (np.concatenate(joints)[:, free] - limits[free, 0]) / (limits[free, 1] - limits[free, 0])
    bins = np.clip((unit * BINS).astype(np.int64), 0, BINS - 1)
    mean = partial(np.mean, dtype=np.float64)
    return {
        "joint_entropy": float(mean([_entropy(column) for column in bins.T])),
        "direction_entropy": float(mean(directions)),
        "position_entropy": float(mean(positions)),
        "surface_coverage": float(mean(surfaces)),
        "direction_coverage": float(mean(shares)),
    }


def _entropy(cells: np.ndarray) -> float:
    """Return Shannon's entropy of how often each number comes, bits."""
    _, counts = np.unique(cells, return_counts=True)
    shares = counts / counts.sum()
    return float(-(shares * np.log2(shares)).sum()) + 0.0
