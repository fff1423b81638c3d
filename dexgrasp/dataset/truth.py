"""Whether a grasp that a representation gives back still is one (METHOD section 1: labels are truthful)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.distance import DistanceField
from dexgrasp.execution import opened
from dexgrasp.geometry import inverse, rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.load_capacity import Load
from dexgrasp.wrench_model import WrenchModel

if TYPE_CHECKING:
    from dexgrasp.closing import Closer, Closure

Clear = Callable[[Grasps], Bool[Tensor, "N"]]
"""Grasps in the frame of `Truth` -> which are clear of table and neighbours."""


@dataclass(frozen=True)
class TruthSettings:
    """What must hold of a grasp that is told."""

    distance: float = 0.05
    """Farthest that the base may have moved from the original, m; farther is not tried."""
    angle: float = math.radians(45)
    """Farthest that it may have turned, rad."""
    close: bool = True
    """Close the fingers again and test what they touch; else distance and angle decide alone."""
    same_distance: float = 1e-4
    """A base that moved and turned by less is the original, whose checks are known to pass, m."""
    same_angle: float = math.radians(0.1)
    opening: float = 0.35
    """By how much joints are opened before they close again, rad; that of execution."""
    penetration: float = 0.001
    """Deepest that the closed hand may reach into the object, m."""
    epsilon: float = 0.05
    """Least quality of the closed grasp; that of synthesis, as are the next three."""
    friction: float = 0.5
    edges: int = 8
    torsion: float | None = None
    capacity: float = 0.0
    """So many times its object's weight the closed grasp must hold (`dexgrasp.load_capacity`), where `up` is known.

    `lift-v1` lifts 74 % of labels on real meshes that hold 1 to 1.5 times the weight, 42 % of those that hold less."""


@dataclass(frozen=True)
class Outcome(Batch):
    """What became of grasps whose fingers were closed on the true object."""

    clear: Bool[Tensor, "N"]
    """Of table and neighbours, on the whole way in."""
    touched: Int[Tensor, "N"]
    """Number of fingers that touch."""
    on_tip: Int[Tensor, "N"]
    """Number of those that touch with the tip."""
    penetration: Float[Tensor, "N"]
    """Depth of the deepest point of the closed hand in the object, m."""
    epsilon: Float[Tensor, "N"]
    capacity: Float[Tensor, "N"]
    """How many times the object's weight the grasp holds."""
    contacts: Float[Tensor, "N F 3"]
    """In the grasps' frame, m; NaN where a finger does not touch, as are the next."""
    normals: Float[Tensor, "N F 3"]
    """Out of the object."""
    com: Float[Tensor, "N 3"]
    """The object's centre of mass, in the grasps' frame, m; of no object: 0, as are the next two."""
    radius: Float[Tensor, "N"]
    """Largest distance from it to the object's surface, m."""
    weight: Float[Tensor, "N"]
    """N, as in `lift-v1`."""


@dataclass(frozen=True, eq=False)
class Body:
    """An object as the closing hand meets it."""

    field: DistanceField
    com: np.ndarray
    """Centre of mass in object coordinates, m."""
    radius: float
    """Torque scale: largest distance from it to the surface, m."""
    volume: float
    """m3"""


def deviation(told: Grasps, original: Grasps) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Return how far (m) and by what angle (rad) the bases of told grasps differ from the originals'."""
    distance = torch.linalg.vector_norm(told.pose[:, :3, 3] - original.pose[:, :3, 3], dim=-1)
    return distance, rotation_angle(told.pose[:, :3, :3], original.pose[:, :3, :3])


class Truth:
    """The checks that grasps of a scene have passed, for grasps that a representation gives back.

    Args:
        closer: closes the hand.
        bodies: the scene's objects; `Grasps.object` counts in them.
        frame_T_object: where they are in the grasps' frame, m.
        settings: how far a grasp may move, and the thresholds of synthesis.
        clear: the scene's own checks, tried last; none where None.
        up: unit vector against gravity in the grasps' frame; None: nobody asks what a grasp can hold.
    """

    def __init__(
        self,
        closer: "Closer",
        bodies: Sequence[Body],
        frame_T_object: Float[Tensor, "O 4 4"],
        settings: TruthSettings | None = None,
        clear: Clear | None = None,
        up: Float[Tensor, "3"] | None = None,
    ) -> None:
        self.closer, self.bodies, self.clear, self.up = closer, bodies, clear, up
        self.object_T_frame = inverse(frame_T_object.double())
        self.settings = settings or TruthSettings()

    def holds(self, told: Grasps, original: Grasps) -> tuple[Bool[Tensor, "N"], Float[Tensor, "N"]]:
        """Return which told grasps still pass, and their quality (the original's where not closed anew; else 0).

        Objects are the originals'.
        """
        limits = self.settings
        distance, angle = deviation(told, original)
        good = (distance <= limits.distance) & (angle <= limits.angle)
        quality = torch.where(good, original.quality, 0.0)
        if not limits.close:
            return good, quality
        same = (distance <= limits.same_distance) & (angle <= limits.same_angle)
        again = good & ~same
        for body in original.object[again].unique().tolist():
            rows = (again & (original.object == body)).nonzero().flatten()
            quality[rows] = self._closed_quality(told[rows], body).to(quality)
            good[rows] = quality[rows] >= limits.epsilon
        if self.up is not None:
            rows = (good & same).nonzero().flatten()
            good[rows] = self.capacity(original[rows]) >= limits.capacity
        rows = (again & good).nonzero().flatten()
        if self.clear is not None and len(rows):
            good[rows] = self.clear(told[rows].replace(object=original.object[rows]))
        return good, torch.where(good, quality, 0.0)

    def capacity(self, grasps: Grasps) -> Float[Tensor, "N"]:
        """Return how many times the weight of its `object` each grasp holds with the contacts that it has."""
        found = torch.zeros(len(grasps), dtype=torch.float64)
        for number in grasps.object.unique().tolist():
            rows = (grasps.object == number).nonzero().flatten()
            own = grasps[rows].moved(self.object_T_frame[number])
            found[rows] = self._capacity(own.pose, own.joints, own.contacts, own.normals, number)
        return found

    def outcome(self, grasps: Grasps) -> Outcome:
        """Close grasps on their own `object` and tell what came of it; nothing is clear or touches where that is -1."""
        count, fingers = len(grasps), len(self.closer.hand.fingers)
        free, whole = grasps.object >= 0, torch.zeros(count, dtype=torch.long)
        none, nowhere = torch.zeros_like(grasps.quality), grasps.contacts.new_full((count, fingers, 3), math.nan)
        places = none.new_zeros(count, 3)
        found = Outcome(free, whole, whole, none, none, none, nowhere, nowhere, places, none, none)
        found = Outcome(**{name: value.clone() for name, value in found.tensors().items()})
        rows = free.nonzero().flatten()
        if self.clear is not None and len(rows):
            found.clear[rows] = self.clear(grasps[rows])
        for number in grasps.object[grasps.object >= 0].unique().tolist():
            rows, body = (grasps.object == number).nonzero().flatten(), self.bodies[number]
            closure = self._closed(grasps[rows], number)
            touches = closure.contacts, closure.normals
            found.touched[rows], found.on_tip[rows] = closure.touched.sum(dim=1), closure.on_tip.sum(dim=1)
            found.penetration[rows] = closure.penetration.to(none)
            found.epsilon[rows] = torch.as_tensor(self._model(body).epsilon(*touches).values).to(none)
            pose = self.object_T_frame[number] @ grasps.pose[rows].double()
            found.capacity[rows] = self._capacity(pose, closure.joints, *touches, number).to(none)
            turn, place = inverse(self.object_T_frame[number])[:3].split([3, 1], dim=1)
            found.contacts[rows] = (closure.contacts.double() @ turn.T + place.T).to(none)
            found.normals[rows] = (closure.normals.double() @ turn.T).to(none)
            found.com[rows] = (torch.as_tensor(body.com).double() @ turn.T + place[:, 0]).to(none)
            found.radius[rows], found.weight[rows] = body.radius, self._load.weight(body.volume)
        return found

    @property
    def _load(self) -> Load:
        return Load(friction=self.settings.friction, edges=self.settings.edges)

    def _capacity(
        self,
        object_T_base: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        contacts: Float[Tensor, "N F 3"],
        normals: Float[Tensor, "N F 3"],
        index: int,
    ) -> Float[Tensor, "N"]:
        """Return how many times the weight of an object closed grasps (its frame) hold; infinite where none asks."""
        if self.up is None:
            return torch.full((len(joints),), math.inf, dtype=torch.float64)
        up = self.object_T_frame[index][:3, :3] @ self.up.double()
        return self._load.capacity(self.closer.hand, self.bodies[index], object_T_base, joints, contacts, normals, up)

    def _closed(self, grasps: Grasps, index: int) -> "Closure":
        touching = grasps.touching
        start = opened(self.closer.hand, grasps.joints.double(), self.settings.opening, touching)
        pose = self.object_T_frame[index] @ grasps.pose.double()
        return self.closer.close(self.bodies[index].field, pose, start, centred=True, touching=touching)

    def _model(self, body: Body) -> WrenchModel:
        limits = self.settings
        return WrenchModel.about(body, self.closer.hand, limits.friction, limits.edges, limits.torsion)

    def _closed_quality(self, grasps: Grasps, index: int) -> Float[Tensor, "N"]:
        """Return epsilon of grasps of one object after closing again; 0 where a check fails."""
        limits, body = self.settings, self.bodies[index]
        closure = self._closed(grasps, index)
        good = ((closure.touched & closure.on_tip) | ~grasps.touching).all(dim=1)
        good &= closure.penetration <= limits.penetration
        quality = grasps.quality.new_zeros(len(grasps))
        if good.any():
            contacts, normals = closure.contacts[good].double(), closure.normals[good].double()
            found = torch.as_tensor(self._model(body).epsilon(contacts, normals, limits.epsilon).values)
            pose = self.object_T_frame[index] @ grasps.pose[good].double()
            held = self._capacity(pose, closure.joints[good], contacts, normals, index)
            quality[good] = torch.where(held >= limits.capacity, found, 0.0).to(quality)
        return quality
