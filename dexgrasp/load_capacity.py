"""Load capacity: how many times the object's weight a grasp holds with the forces that the hand really has.

Epsilon asks what unit forces hold against a wrench from any direction; a hand lifts what is heavy or held far from its
centre of mass only if its own forces, inside the friction cones, balance that weight. Capacity is the largest t for
which contact forces, each with at most the normal force that the finger's joints can exert, hold t times the weight:
a linear program in the forces along the cones' edges (Kerr & Roth 1986; task-oriented quality of Li & Sastry 1988 for
one wrench). It is solved by the simplex method.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from dexgrasp import wrench_model
from dexgrasp.contact_wrenches import compiled_wrenches, cone_edges
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse, transform
from dexgrasp.hand import Hand

STEP = 1e-4
"""Of a joint (rad or m), by which a contact's way is measured."""
LEAST_LEVER = 1e-3
"""m: nearer to a joint's axis a contact counts as so far from it, else its force would have no limit."""
PIVOTS = 400
"""More than any grasp of ten fingers needed; what is reached by then holds, as every corner of the program does."""
ZERO = 1e-9
ENOUGH = 1.5
"""Capacity beyond which more is soon worth little, see `lifts`."""


class Body(wrench_model.Body, Protocol):
    """What must be known of an object."""

    @property
    def volume(self) -> float:
        """m3"""


@dataclass(frozen=True)
class Load:
    """What is held, and with what; masses and gravity as in `lift-v1`, friction as in synthesis, with a margin."""

    density: float = 500.0
    """kg/m3"""
    lightest: float = 0.05
    """kg, as is the next."""
    heaviest: float = 1.0
    gravity: float = 9.81
    """m/s2"""
    friction: float = 0.5
    torsion: float = 0.02
    """Torque about the normal that unit normal force can hold, m."""
    edges: int = 8
    effort: float = 1.0
    """Share of the joints' limits with which the hand grips."""

    def __post_init__(self) -> None:
        positive = self.density, self.lightest, self.gravity, self.effort
        if min(positive) <= 0 or self.heaviest < self.lightest or self.friction < 0 or self.torsion < 0:
            raise DexgraspError("positive density, masses in order, gravity, effort", str(self), "mend the load")

    def weight(self, volume: float) -> float:
        """Return the weight (N) of an object of so many m3."""
        return self.gravity * float(np.clip(self.density * volume, self.lightest, self.heaviest))

    def capacity(
        self,
        hand: Hand,
        body: Body,
        object_T_base: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        contacts: Float[Tensor, "N F 3"],
        normals: Float[Tensor, "N F 3"],
        up: Float[Tensor, "3"],
    ) -> Float[Tensor, "N"]:
        """Return how many times its own weight each closed grasp holds; all in the object's frame.

        `normals` point out of the object; contacts of NaN are of fingers that do not touch. `up` is the unit vector
        against gravity.
        """
        weight = self.weight(body.volume)
        limits = self.effort * normal_forces(hand, object_T_base, joints, contacts, normals) / weight
        told = contacts.double().numpy(), normals.double().numpy(), np.asarray(body.com, dtype=float), body.radius
        wrenches = compiled_wrenches(*told, self.friction, self.torsion, cone_edges(self.edges, self.torsion > 0))
        held = np.concatenate([up.double().numpy(), np.zeros(3)])
        return torch.from_numpy(capacities(wrenches, limits.double().nan_to_num(0.0).numpy(), held))


def lifts(capacity: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """Return about how likely a network's grasp lifts that holds so many times the weight: 1 - exp(-capacity / 1.5).

    `lift-v1` lifted 26, 41, 78, 86, 91, 95 % of 1,200 in clutter that held below 0.5, 1, 2, 3, 5 times, and more.
    """
    return 1 - torch.exp(-capacity / ENOUGH)


def normal_forces(
    hand: Hand,
    object_T_base: Float[Tensor, "N 4 4"],
    joints: Float[Tensor, "N J"],
    contacts: Float[Tensor, "N F 3"],
    normals: Float[Tensor, "N F 3"],
) -> Float[Tensor, "N F"]:
    """Return the largest normal force (N) that each finger's closing joints can exert at its contact; NaN for NaN.

    A normal force F turns joint j by F (n . dp/dq_j), which its effort must hold; the weakest joint decides.
    """
    base = object_T_base.double()
    q, back = joints.double(), inverse(base)
    here = torch.stack([transform(back, contacts[:, row].double()) for row in range(len(hand.fingers))], dim=1)
    outward = normals.double() @ base[:, :3, :3]
    poses, limits = hand.link_poses(q), here.new_full(here.shape[:2], float("inf"))
    for name in {name for finger in hand.fingers for name in finger.closing}:
        joint = hand.joint_names.index(name)
        moved = q.clone()
        moved[:, joint] += STEP
        after = hand.link_poses(moved)
        for row, finger in enumerate(hand.fingers):
            if name in finger.closing:
                local = transform(inverse(poses[finger.link]), here[:, row])
                way = (transform(after[finger.link], local) - here[:, row]) / STEP
                lever = (way * outward[:, row]).sum(dim=1).abs().clamp(min=LEAST_LEVER)
                limits[:, row] = torch.minimum(limits[:, row], float(hand.efforts[joint]) / lever)
    return torch.where(here.isnan().any(dim=2), torch.nan, limits)


@njit(cache=True)
def capacities(wrenches: np.ndarray, limits: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the largest t (N,) with sum(a w) = t held, a >= 0, and at most `limits` (N, F) summed over each contact.

    `wrenches` (N, F P, 6) of unit normal force; the load is -held.
    """
    count, columns, contacts = wrenches.shape[0], wrenches.shape[1], limits.shape[1]
    edges, rows = columns // contacts, 6 + contacts
    # Columns: t, forces, slacks of the limits, right side. Rows: six balances, limits; the last is the price of t.
    width = 1 + columns + contacts + 1
    table, basis = np.empty((rows + 1, width)), np.empty(rows, np.int64)
    result = np.zeros(count)
    for i in range(count):
        table[:] = 0.0
        for k in range(6):
            table[k, 0] = -held[k]
            for c in range(columns):
                table[k, 1 + c] = wrenches[i, c, k]
            basis[k] = -1  # an artificial variable, which is and stays 0
        for f in range(contacts):
            for e in range(edges):
                table[6 + f, 1 + f * edges + e] = 1.0
            table[6 + f, 1 + columns + f] = 1.0
            table[6 + f, width - 1] = limits[i, f]
            basis[6 + f] = 1 + columns + f
        table[rows, 0] = -1.0
        for pivot in range(PIVOTS):
            enter, least = -1, -ZERO
            for c in range(width - 1):
                if table[rows, c] < least:
                    enter = c
                    if pivot > PIVOTS // 2:  # Bland's rule, which cannot go round in circles
                        break
                    least = table[rows, c]
            if enter < 0:
                break
            leave, ratio, size = -1, np.inf, 0.0
            for r in range(rows):
                entry = table[r, enter]
                if basis[r] < 0 and abs(entry) > ZERO:
                    step, entry = 0.0, abs(entry)
                elif entry > ZERO:
                    step = max(table[r, width - 1], 0.0) / entry
                else:
                    continue
                if step < ratio - 1e-12 or (step <= ratio + 1e-12 and entry > size):
                    leave, ratio, size = r, step, entry
            if leave < 0:
                break
            _pivot(table, leave, enter)
            basis[leave] = enter
        for r in range(rows):
            if basis[r] == 0:
                result[i] = table[r, width - 1]
    return result


@njit(cache=True)
def _pivot(table: np.ndarray, leave: int, enter: int) -> None:
    scale = 1.0 / table[leave, enter]
    for c in range(table.shape[1]):
        table[leave, c] *= scale
    for r in range(table.shape[0]):
        factor = table[r, enter]
        if r != leave and factor != 0.0:
            for c in range(table.shape[1]):
                table[r, c] -= factor * table[leave, c]
