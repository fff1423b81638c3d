"""Where hands might grasp: candidates with open fingers, before any is closed (METHOD section 4)."""

import math
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.contact_frame import place
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import inverse
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.quality import epsilon, wrenches

TRIES = 12
"""A contact-first candidate is the most promising of this many draws."""
APPROACHES = 4
"""Palm-first candidates are those out of this many draws that stay above the table, where there are enough."""
VARIATIONS = 4
"""A varied one of this many."""
FRICTION = 0.5
"""Of the contacts that are guessed to judge a draw."""
GAP, QUALITY = 0.01, 0.05
"""What a centimetre of gaps costs is what this much epsilon is worth."""
WANDER = 0.012
"""How far on the surface a varied grasp's contact may move, m."""


@dataclass(frozen=True)
class Surface:
    """What proposals know of an object. Object frame, metres, float64."""

    points: Float[Tensor, "P 3"]
    """Spread uniformly: at most one in each voxel."""
    normals: Float[Tensor, "P 3"]
    center: Float[Tensor, "3"]
    """Centre of mass."""
    radius: float
    field: DistanceField
    tables: Float[Tensor, "K 4"]
    """Heights above the table, a . x + b, in the resting poses that count; none where there is no table."""

    @classmethod
    def sample(
        cls,
        item: Object,
        field: DistanceField,
        spacing: float,
        rng: np.random.Generator,
        tables: Float[Tensor, "K 4"] | None = None,
    ) -> "Surface":
        """Sample an object's surface uniformly in voxel space, voxels of `spacing` (m)."""
        count = int(np.clip(8 * item.mesh.area / spacing**2, 1000, 200_000))
        points, faces = trimesh.sample.sample_surface(item.mesh, count, seed=int(rng.integers(2**31)))
        _, first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
        first = rng.permutation(first)
        return cls(
            points=torch.from_numpy(np.asarray(points[first])),
            normals=torch.from_numpy(np.asarray(item.mesh.face_normals[faces[first]])),
            center=torch.from_numpy(np.asarray(item.com)),
            radius=item.radius,
            field=field,
            tables=torch.zeros(0, 4, dtype=torch.float64) if tables is None else tables,
        )

    def out_of_reach(self, points: Float[Tensor, "N P 3"]) -> Bool[Tensor, "N"]:
        """Return for which sets of points some lie under the table, whatever way the object rests."""
        if not len(self.tables):
            return torch.zeros(len(points), dtype=torch.bool)
        heights = points @ self.tables[:, :3].T + self.tables[:, 3]
        return (heights.amin(dim=1) < 0).all(dim=1)

    def nearest(self, points: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Return the nearest surface point of each."""
        return torch.from_numpy(cKDTree(self.points.numpy()).query(points.numpy())[1])


@dataclass(frozen=True)
class Contacts:
    """Fingertip contacts from which hands are placed: what a contact-first proposal varies."""

    point: Int[Tensor, "N"]
    """Index in the surface."""
    finger: Int[Tensor, "N"]
    xy: Float[Tensor, "N 2"]
    joints: Float[Tensor, "N J"]
    """Posture when the finger touches; all fingers closed alike."""

    def __getitem__(self, index: Tensor) -> "Contacts":
        return Contacts(self.point[index], self.finger[index], self.xy[index], self.joints[index])

    @classmethod
    def cat(cls, parts: "list[Contacts]") -> "Contacts":
        """Join several."""
        names = ("point", "finger", "xy", "joints")
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def opened(hand: Hand, joints: Float[Tensor, "N J"]) -> Float[Tensor, "N J"]:
    """Return the postures with every closing joint at the limit from which it closes."""
    result = joints.clone()
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            place_ = hand.joint_names.index(joint)
            result[:, place_] = hand.limits[place_, 0 if rate > 0 else 1].to(joints)
    return result


def approach(
    hand: Hand, surface: Surface, count: int, rng: np.random.Generator
) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
    """Propose hands whose palm looks along a surface normal: depth x in-plane rotation x spread (the paper's way).

    Returns object_T_base and open postures. Depth is the palm's distance from the point, up to the hand's reach.
    """
    total = count * APPROACHES
    pick = torch.from_numpy(rng.integers(len(surface.points), size=total))
    unit = torch.from_numpy(_strata(rng, total, 2))
    joints = opened(hand, _uniform(hand, rng, total))
    z = -surface.normals[pick]
    helper = torch.eye(3, dtype=torch.float64)[z.abs().argmin(dim=1)]
    x = torch.nn.functional.normalize(torch.linalg.cross(z, helper), dim=1)
    y = torch.linalg.cross(z, x)
    roll = 2 * math.pi * unit[:, :1]
    x = torch.cos(roll) * x + torch.sin(roll) * y
    object_T_palm = torch.eye(4, dtype=torch.float64).repeat(total, 1, 1)
    object_T_palm[:, :3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=2)
    depth = 0.005 + (_reach(hand) - 0.005) * unit[:, 1:]
    object_T_palm[:, :3, 3] = surface.points[pick] - depth * z
    pose = object_T_palm @ inverse(hand.base_T_palm)
    under = surface.out_of_reach(torch.stack([object_T_palm[:, :3, 3], pose[:, :3, 3]], dim=1))
    best = torch.argsort(under.long(), stable=True)[:count]
    return pose[best], joints[best]


def contact(hand: Hand, surface: Surface, count: int, rng: np.random.Generator) -> Contacts:
    """Propose hands from one fingertip contact: uniform draws, the most promising of every few kept."""
    total = count * TRIES
    finger = torch.from_numpy(rng.integers(len(hand.fingers), size=total))
    joints = _uniform(hand, rng, total)
    _close_alike(hand, joints, torch.from_numpy(rng.uniform(0.15, 0.85, size=total)))
    # Directions of the finger, uniform on the half sphere over the tangent plane: uniform z.
    angle, z = rng.uniform(0, 2 * math.pi, total), rng.uniform(0.05, 1, total)
    xy = torch.from_numpy(np.sqrt(1 - z**2)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    drawn = Contacts(torch.from_numpy(rng.integers(len(surface.points), size=total)), finger, xy, joints)
    return _best(hand, surface, drawn, count)


def varied(hand: Hand, surface: Surface, parents: Contacts, count: int, rng: np.random.Generator) -> Contacts:
    """Propose variations of contacts that led to grasps: moved on the surface, turned and closed a little."""
    total = count * VARIATIONS
    pick = torch.from_numpy(rng.integers(len(parents.point), size=total))
    moved = surface.points[parents.point[pick]] + torch.from_numpy(rng.normal(scale=WANDER, size=(total, 3)))
    point = surface.nearest(moved)
    span = (hand.limits[:, 1] - hand.limits[:, 0]).clamp(max=math.pi)
    noise = torch.from_numpy(rng.normal(scale=0.05, size=(total, len(span)))) * span
    xy = parents.xy[pick] + torch.from_numpy(rng.normal(scale=0.12, size=(total, 2)))
    xy = xy / torch.linalg.vector_norm(xy, dim=1, keepdim=True).clamp(min=1.0)
    drawn = Contacts(point, parents.finger[pick], xy, hand.clamp(parents.joints[pick] + noise))
    return _best(hand, surface, drawn, count)


def placed(hand: Hand, surface: Surface, contacts: Contacts) -> Float[Tensor, "N 4 4"]:
    """Return object_T_base of hands that touch as told."""
    points, normals = surface.points[contacts.point], surface.normals[contacts.point]
    return place(hand, contacts.finger, points, normals, contacts.xy, contacts.joints)


def _best(hand: Hand, surface: Surface, drawn: Contacts, count: int) -> Contacts:
    """Keep the most promising of every group of draws.

    Each finger is taken to touch where its fingertip circle is nearest to the surface: small gaps, a high epsilon of
    these contacts and a palm outside the object are what a grasp is made of.
    """
    pose = placed(hand, surface, drawn)
    tips = (pose[:, None] @ hand.fingertips(drawn.joints))[..., :3, 3]
    radius = torch.tensor([finger.tip_radius for finger in hand.fingers], dtype=torch.float64)
    found = surface.field.nearest(tips.reshape(-1, 3))
    distance, points, normals = (torch.as_tensor(part).reshape(*tips.shape[:2], -1) for part in found)
    gaps = (distance.squeeze(-1) - radius).abs().sum(dim=1)
    quality = torch.as_tensor(epsilon(wrenches(points, normals, surface.center, surface.radius, FRICTION)))
    palm = (pose @ hand.base_T_palm)[:, :3, 3]
    buried = torch.as_tensor(surface.field.lower_bound(palm)) < 0.002
    under = surface.out_of_reach(torch.cat([tips, palm[:, None], pose[:, None, :3, 3]], dim=1))
    cost = gaps / GAP - quality / QUALITY + 100.0 * (buried | under)
    group = len(pose) // count
    best = cost.reshape(count, group).argmin(dim=1)
    return drawn[torch.arange(count) * group + best]


def _close_alike(hand: Hand, joints: Tensor, part: Tensor) -> None:
    """Set every closing joint to the same part of its range, in place."""
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            index = hand.joint_names.index(joint)
            low, high = hand.limits[index] if rate > 0 else hand.limits[index].flip(0)
            joints[:, index] = low + (high - low) * part


def _uniform(hand: Hand, rng: np.random.Generator, count: int) -> Tensor:
    low, high = hand.limits.T
    return low + (high - low) * torch.from_numpy(rng.uniform(size=(count, len(low))))


def _strata(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Return `count` points of the unit cube, each coordinate stratified."""
    order = np.stack([rng.permutation(count) for _ in range(size)], axis=1)
    return (order + rng.uniform(size=(count, size))) / count


def _reach(hand: Hand) -> float:
    """Return how far the fingertips get along the palm's axis with fingers half closed (m)."""
    middle = hand.limits.mean(dim=1, keepdim=True).T.clone()
    heights = []
    for part in np.linspace(0, 1, 9):
        _close_alike(hand, middle, torch.tensor([part], dtype=torch.float64))
        tips = inverse(hand.base_T_palm) @ hand.fingertips(middle)[0]
        heights.append(float(tips[:, 2, 3].max()))
    return max(heights)
