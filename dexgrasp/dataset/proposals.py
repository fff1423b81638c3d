"""Where hands might grasp: candidates with open fingers, before any is closed (METHOD section 4)."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.contact_frame import place, to_disc
from dexgrasp.dataset.surface import Surface
from dexgrasp.execution import opened
from dexgrasp.geometry import inverse
from dexgrasp.hand import Hand
from dexgrasp.synergies import synergetic

WANDER = 0.008
"""How far on the surface a varied draw's point moves, m (standard deviation, as below)."""
STIR = 0.035
"""How far a varied draw's joints move, as a part of their range."""
TURN = 0.085
"""How far a varied finger projection moves."""
SHIFT, ROLL = 0.006, 0.15
"""How far a varied palm moves along the normal, m, and turns about it, rad."""
EXCHANGE = 0.1
"""Share of varied draws whose fingers are drawn anew."""
SLOWEST, FASTEST = 0.15, 0.85
"""A finger's contact is drawn with its closing joints between these parts of their ranges."""


BEND = 0.15
"""Joints that close one finger together are drawn so far apart from each other, parts of their ranges."""


@dataclass(frozen=True)
class Draws(Batch):
    """What a proposer drew, as numbers that it can vary."""

    point: Int[Tensor, "N"]
    """Index in the surface."""
    finger: Int[Tensor, "N"]
    """The finger that touches there; -1 where it is the palm that faces the point."""
    place: Float[Tensor, "N 2"]
    """`contact`: finger projection x, y. `approach`: depth (m), roll (rad)."""
    joints: Float[Tensor, "N J"]
    """`contact`: the posture in which the finger touches. `approach`: the open posture."""
    touching: Bool[Tensor, "N F"]
    """Fingers that are to close; the others stay open."""


class Proposer(ABC):
    """One way of proposing hands for an object."""

    def __init__(self, hand: Hand, sets: Bool[Tensor, "S F"] | None = None) -> None:
        """Of `sets` of fingers that are to touch, those of every size are drawn alike; None: all fingers."""
        self.hand = hand
        self.sets = torch.ones(1, len(hand.fingers), dtype=torch.bool) if sets is None else sets

    @abstractmethod
    def draw(self, surface: Surface, count: int, rng: np.random.Generator) -> Draws:
        """Draw from nothing: points of the surface and places in strata, so that none is left out."""

    @abstractmethod
    def vary(self, surface: Surface, parents: Draws, step: float, rng: np.random.Generator) -> Draws:
        """Draw near each of some that led to grasps: moved on the surface, turned and closed a little times `step`."""

    @abstractmethod
    def hands(self, surface: Surface, draws: Draws) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
        """Return object_T_base (m) and joints with open fingers."""

    def _fingers(self, finger: Int[Tensor, "N"], rng: np.random.Generator) -> Bool[Tensor, "N F"]:
        """Draw which fingers are to touch, among them `finger` (-1: any): every number of fingers as often."""
        if len(self.sets) == 1:
            return self.sets.repeat(len(finger), 1)
        drawn = torch.empty(len(finger), self.sets.shape[1], dtype=torch.bool)
        for one in finger.unique().tolist():
            able = self.sets if one < 0 else self.sets[self.sets[:, one]]
            size = able.sum(dim=1).numpy()
            weight = 1.0 / np.bincount(size)[size]
            rows = (finger == one).nonzero().flatten()
            drawn[rows] = able[torch.from_numpy(rng.choice(len(able), size=len(rows), p=weight / weight.sum()))]
        return drawn

    def _exchanged(self, parents: Draws, rng: np.random.Generator) -> Bool[Tensor, "N F"]:
        """Return the parents' fingers, a few of them drawn anew."""
        if len(self.sets) == 1:
            return parents.touching
        again = torch.from_numpy(rng.uniform(size=(len(parents), 1)) < EXCHANGE)
        return torch.where(again, self._fingers(parents.finger, rng), parents.touching)


class Approach(Proposer):
    """The palm looks along a surface normal: depth x in-plane rotation x spread (the paper's way)."""

    def __init__(self, hand: Hand, sets: Bool[Tensor, "S F"] | None = None) -> None:
        super().__init__(hand, sets)
        self.reach = _reach(hand)

    def draw(self, surface: Surface, count: int, rng: np.random.Generator) -> Draws:
        """Depth is the palm's distance from the point, up to the hand's reach."""
        unit = torch.from_numpy(_strata(rng, count, 2))
        place = torch.stack([0.005 + (self.reach - 0.005) * unit[:, 0], 2 * math.pi * unit[:, 1]], dim=1)
        joints = opened(self.hand, synergetic(self.hand, _uniform(self.hand, rng, count), rng))
        finger = torch.full((count,), -1)
        return Draws(_points(surface, count, rng), finger, place, joints, self._fingers(finger, rng))

    def vary(self, surface: Surface, parents: Draws, step: float, rng: np.random.Generator) -> Draws:
        """See `Proposer.vary`."""
        noise = torch.from_numpy(rng.normal(scale=step * np.array([SHIFT, ROLL]), size=(len(parents), 2)))
        moved = parents.replace(
            point=_wandered(surface, parents, step, rng),
            place=parents.place + noise,
            joints=_stirred(self.hand, parents, step, rng),
            touching=self._exchanged(parents, rng),
        )
        return moved.replace(joints=opened(self.hand, moved.joints))

    def hands(self, surface: Surface, draws: Draws) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
        """See `Proposer.hands`."""
        z = -surface.normals[draws.point]
        helper = torch.eye(3, dtype=torch.float64)[z.abs().argmin(dim=1)]
        x = torch.nn.functional.normalize(torch.linalg.cross(z, helper), dim=1)
        depth, roll = draws.place[:, :1], draws.place[:, 1:]
        x = torch.cos(roll) * x + torch.sin(roll) * torch.linalg.cross(z, x)
        object_T_palm = torch.eye(4, dtype=torch.float64).repeat(len(draws), 1, 1)
        object_T_palm[:, :3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=2)
        object_T_palm[:, :3, 3] = surface.points[draws.point] - depth * z
        return object_T_palm @ inverse(self.hand.base_T_palm), draws.joints


class Contact(Proposer):
    """A fingertip contact, its finger projection and main joints place the hand (METHOD section 1)."""

    def draw(self, surface: Surface, count: int, rng: np.random.Generator) -> Draws:
        """Directions of the finger are uniform on the half sphere over the tangent plane."""
        joints = _uniform(self.hand, rng, count)
        part = torch.from_numpy(rng.uniform(SLOWEST, FASTEST, size=(count, 1))).repeat(1, joints.shape[1])
        if any(len(finger.closing) > 1 for finger in self.hand.fingers):
            part = (part + torch.from_numpy(rng.normal(scale=BEND, size=part.shape))).clamp(0, 1)
        _close_alike(self.hand, joints, part)
        joints = synergetic(self.hand, joints, rng)
        unit = torch.from_numpy(_strata(rng, count, 2))
        angle, z = 2 * math.pi * unit[:, :1], 0.05 + 0.95 * unit[:, 1:]  # uniform z: uniform on the sphere
        xy = torch.sqrt(1 - z**2) * torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)
        finger = torch.from_numpy(rng.permutation(count) % len(self.hand.fingers))
        return Draws(_points(surface, count, rng), finger, xy, joints, self._fingers(finger, rng))

    def vary(self, surface: Surface, parents: Draws, step: float, rng: np.random.Generator) -> Draws:
        """See `Proposer.vary`."""
        xy = to_disc(parents.place + torch.from_numpy(rng.normal(scale=step * TURN, size=(len(parents), 2))))
        return parents.replace(
            point=_wandered(surface, parents, step, rng),
            place=xy,
            joints=_stirred(self.hand, parents, step, rng),
            touching=self._exchanged(parents, rng),
        )

    def hands(self, surface: Surface, draws: Draws) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
        """See `Proposer.hands`."""
        points, normals = surface.points[draws.point], surface.normals[draws.point]
        pose = place(self.hand, draws.finger, points, normals, draws.place, draws.joints)
        return pose, opened(self.hand, draws.joints)


def _points(surface: Surface, count: int, rng: np.random.Generator) -> Int[Tensor, "N"]:
    """Draw points, each as often as any other, give or take one."""
    total = len(surface.points)
    rounds = [rng.permutation(total) for _ in range(-(-count // total))]
    return torch.from_numpy(np.concatenate(rounds)[:count])


def _wandered(surface: Surface, parents: Draws, step: float, rng: np.random.Generator) -> Int[Tensor, "N"]:
    moved = surface.points[parents.point] + torch.from_numpy(rng.normal(scale=step * WANDER, size=(len(parents), 3)))
    return surface.nearest(moved)


def _stirred(hand: Hand, parents: Draws, step: float, rng: np.random.Generator) -> Float[Tensor, "N J"]:
    span = (hand.limits[:, 1] - hand.limits[:, 0]).clamp(max=math.pi)
    return hand.clamp(
        parents.joints + torch.from_numpy(rng.normal(scale=step * STIR, size=parents.joints.shape)) * span
    )


def _close_alike(hand: Hand, joints: Tensor, part: Tensor) -> None:
    """Set every closing joint to the same part (N,) or to its own part (N, J) of its range, in place."""
    part = part if part.ndim == 2 else part[:, None].expand(-1, joints.shape[1])
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            index = hand.joint_names.index(joint)
            low, high = hand.limits[index] if rate > 0 else hand.limits[index].flip(0)
            joints[:, index] = low + (high - low) * part[:, index]


def _uniform(hand: Hand, rng: np.random.Generator, count: int) -> Tensor:
    low, high = hand.limits.T
    return low + (high - low) * torch.from_numpy(rng.uniform(size=(count, len(low))))


def _strata(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Return `count` points of the unit cube, each coordinate stratified."""
    order = np.stack([rng.permutation(count) for _ in range(size)], axis=1)
    return (order + rng.uniform(size=(count, size))) / count


def _reach(hand: Hand) -> float:
    """Return how far the fingertips get along the palm's axis while the fingers close (m)."""
    middle = hand.limits.mean(dim=1, keepdim=True).T.clone()
    heights = []
    for part in np.linspace(0, 1, 9):
        _close_alike(hand, middle, torch.tensor([part], dtype=torch.float64))
        tips = inverse(hand.base_T_palm) @ hand.fingertips(middle)[0]
        heights.append(float(tips[:, 2, 3].max()))
    return max(heights)
