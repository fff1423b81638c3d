"""How good a posture near an object is before it touches: contact energy, and the quality that it may come to have."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from dexgrasp.distance import Field, seed_at
from dexgrasp.hand_body import carry
from dexgrasp.triangle_tree import nearest

REACH = 0.05
"""Contacts nearer than this count in the potential quality, m,"""
FACING = 0.7
"""whose cosine between the hand's normal and the way to the object is at least this,"""
COUNTED = 0.25
"""and which weigh more than this."""
TURNED = 50.0
"""Contact energy of a contact that faces away is twice this; distances count in mm."""


class Wanted(NamedTuple):
    """Desired contacts of a hand, and how their quality is told."""

    links: np.ndarray
    """(C,) link of each."""
    points: np.ndarray
    """(C, 6) point, m, and outward unit normal in that link's frame."""
    directions: np.ndarray
    """(D, 3) unit vectors in which the wrench space is measured."""
    friction: float
    least: int
    """Fewest contacts that count, for a potential quality to be told."""
    guided: bool
    """False: contact energy alone."""


@njit(cache=True, error_model="numpy")
def state_energy(
    wanted: Wanted, field: Field, poses: np.ndarray, hit: np.ndarray, weighed: np.ndarray, alone: np.ndarray
) -> float:
    """Return the energy of links at object_T_link `poses` (L, 3, 4); lower is better, below 0 a grasp may be formed.

    Contact energy: the mean over the desired contacts of distance (mm) and 50 (1 - cosine of normal and way there).
    Guided: where at least `least` contacts are near and their forces, weighed by nearness, could hold a force from
    any side, it is minus the least of those forces instead. `hit` (7,), `weighed` (C, 4) and `alone` (1,) are scratch;
    `alone` gets the contact energy.
    """
    total, near = 0.0, 0
    for c in range(len(wanted.links)):
        link = wanted.links[c]
        x, y, z = carry(poses, link, wanted.points, c)
        nearest(field.tree, x, y, z, seed_at(field, x, y, z), hit)
        facing = 0.0
        for k in range(3):
            normal = 0.0
            for m in range(3):
                normal += poses[link, k, m] * wanted.points[c, 3 + m]
            weighed[near, k] = normal
            facing -= normal * hit[4 + k]
        distance = abs(hit[0])
        total += 1000.0 * distance + TURNED * (1.0 - facing)
        if wanted.guided and facing >= FACING and distance <= REACH:
            weighed[near, 3] = math.cos(math.pi * distance / REACH) + 1.0
            if weighed[near, 3] > COUNTED:
                near += 1
    alone[0] = total / len(wanted.links)
    if near < wanted.least:
        return alone[0]
    held = np.inf
    for d in range(len(wanted.directions)):
        most = -np.inf
        for c in range(near):
            along = 0.0
            for k in range(3):
                along += weighed[c, k] * wanted.directions[d, k]
            across = math.sqrt(max(0.0, 1.0 - along * along))
            most = max(most, weighed[c, 3] * (along + wanted.friction * across))
        held = min(held, most)
        if held < 0.0:
            return alone[0]
    return -held
