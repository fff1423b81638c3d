"""Grasps spread over an object: near-duplicates, regions, and how much of the object is reached."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.dataset.surface import Surface
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand

REGION, TURN = 0.015, 0.5
"""Grasps are of one region whose contacts' means and approach axes fall into one cell, m and of a unit vector."""
NEAR, ALIGNED = 0.005, math.radians(20)
"""A surface point is reached by a contact this near, m, whose normal is this near, rad: what labels it (METHOD 2)."""
SPARED = 0x9E3779B97F4A7C1
"""Grasps with fewer fingers are of other regions: an odd number that moves their keys."""
ROOM = 0.001
"""A fingertip can touch where it would be at most this deep in the object, m."""
DIRECTIONS = 200
"""Approach directions are counted in this many equal parts of the sphere."""


@dataclass(frozen=True)
class Coverage:
    """How much of an object its grasps reach."""

    surface: float
    """Share of the points that a fingertip can touch which lie within 5 mm and 20 deg of a grasp's contact."""
    directions: float
    """Share of 200 equal parts of the sphere of approach directions, object frame, that hold a grasp."""


def distinct(grasps: Grasps, hand: Hand, position: float, angle: float, joints: float) -> Int[Tensor, "K"]:
    """Return the best grasp of each cell of palm position (m) x palm axes (rad) x joints, in order of discovery."""
    palm = grasps.pose @ hand.base_T_palm
    axes = palm[:, :3, [0, 2]].flatten(1)
    cells = _keys(torch.cat([palm[:, :3, 3] / position, axes / angle, grasps.joints / joints], dim=1))
    order = np.lexsort((-grasps.quality.numpy(), cells))
    first = np.r_[True, cells[order][1:] != cells[order][:-1]] if len(order) else np.zeros(0, dtype=bool)
    return torch.from_numpy(np.sort(order[first]))


def regions(grasps: Grasps) -> Int[np.ndarray, "N"]:
    """Return the number of each grasp's region: where on the object, from which side, and with how many fingers."""
    cells = _keys(torch.cat([grasps.contacts.nanmean(dim=1) / REGION, grasps.pose[:, :3, 2] / TURN], dim=1))
    cells ^= (~grasps.touching).sum(dim=1).numpy() * SPARED
    return np.unique(cells, return_inverse=True)[1].reshape(-1)


def spread(grasps: Grasps) -> Int[Tensor, "N"]:
    """Order grasps so that every region comes once, its best grasp first, then every region again."""
    if not len(grasps):
        return torch.zeros(0, dtype=torch.long)
    region, quality = regions(grasps), grasps.quality.numpy()
    order = np.lexsort((-quality, region))
    sorted_regions = region[order]
    starts = np.flatnonzero(np.r_[True, sorted_regions[1:] != sorted_regions[:-1]])
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    return torch.from_numpy(order[np.lexsort((-quality[order], rank))])


def coverage(hand: Hand, surface: Surface, grasps: Grasps) -> Coverage:
    """Return how much of an object its grasps (object frame) reach."""
    radius = min(finger.tip_radius for finger in hand.fingers)
    room = torch.as_tensor(surface.field.distance(surface.points + radius * surface.normals)) >= radius - ROOM
    touched = ~grasps.contacts.isnan().any(dim=-1)
    if not touched.any():
        return Coverage(0.0, 0.0)
    contacts = _scaled(grasps.contacts[touched], grasps.normals[touched])
    away, _ = cKDTree(contacts).query(_scaled(surface.points[room], surface.normals[room]), distance_upper_bound=1.0)
    parts = direction_parts((grasps.pose.double() @ hand.base_T_palm)[:, :3, 2].numpy())
    return Coverage(float(np.isfinite(away).mean()) if len(away) else 0.0, len(np.unique(parts)) / DIRECTIONS)


def direction_parts(directions: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """Return which of 200 equal parts of the sphere each unit vector lies in."""
    return np.asarray(cKDTree(_sphere(DIRECTIONS)).query(directions)[1])


def _scaled(points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"]) -> Float[np.ndarray, "N 6"]:
    """Positions and normals as points that are 1 apart where they just count as near."""
    return torch.cat([points / NEAR, normals / (2 * math.sin(ALIGNED / 2))], dim=1).double().numpy()


def _sphere(count: int) -> Float[np.ndarray, "N 3"]:
    """Return directions that share the sphere out equally (Fibonacci's lattice)."""
    number = np.arange(count)
    z, turn = 1 - (2 * number + 1) / count, np.pi * (3 - np.sqrt(5)) * number
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _keys(numbers: Float[Tensor, "N K"]) -> Int[np.ndarray, "N"]:
    """Return one number for each row's cell of unit width; different cells differ but for one chance in 2^64."""
    cells = numbers.floor().long().numpy()
    factors = np.asarray(np.random.default_rng(0).integers(-(2**62), 2**62, size=cells.shape[1])) * 2 + 1
    keys = np.zeros(len(cells), dtype=np.int64)
    for column in range(cells.shape[1]):
        keys = (keys ^ cells[:, column]) * factors[column]
        keys ^= keys >> 29
    return keys
