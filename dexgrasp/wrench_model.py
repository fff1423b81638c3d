"""What an epsilon is about, as one value that is stored with it: `WrenchModel`, and `Quality`, figures with theirs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from dexgrasp import quality
from dexgrasp.contact_wrenches import cone_edges
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.touching import fewest_fingers

Array = Tensor | np.ndarray
HULLS = ("l1", "linf")
TWO_FINGERS = 0.02
"""Torsion of a hand that grasps with two fingers, m: hard contacts hold no torque about the line through them. As in
`lift-v1`. Its grasps with more fingers have it, too: else two soft fingers would seem better than four hard ones.
"""


def torsion_of(least: int, torsion: float | None) -> float:
    """Return the torsion (m) of a hand of which at least so many fingers touch; `torsion` where it is given."""
    return (TWO_FINGERS if least == 2 else 0.0) if torsion is None else torsion


class Body(Protocol):
    """What a wrench model must know of an object."""

    @property
    def com(self) -> np.ndarray:
        """Centre of mass, m, in the frame of the contacts."""

    @property
    def radius(self) -> float:
        """Largest distance from it to the surface, m."""


@dataclass(frozen=True)
class WrenchModel:
    """How contacts become wrenches and wrenches a figure (METHOD section 5); compares, hashes, and goes to JSON."""

    origin: tuple[float, float, float]
    """About which torques are taken, m, in the frame of the contacts; usually the centre of mass."""
    scale: float
    """Torques are divided by it, m; usually the largest distance from the origin to the surface."""
    friction: float = 0.5
    edges: int = 8
    """Of a friction cone, which is inscribed: epsilon grows with their number."""
    torsion: float = 0.0
    """Torque about the normal that unit normal force can hold, m; 0: hard finger, else soft finger."""
    hull: Literal["l1", "linf"] = "l1"
    """Normal forces that sum up to 1 (hull of all wrenches), or of up to 1 each (Minkowski sum over contacts)."""

    def __post_init__(self) -> None:
        origin: Sequence[float] = tuple(float(value) for value in self.origin)
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "scale", float(self.scale))
        sound = len(origin) == 3 and np.isfinite(origin).all() and 0 < self.scale < np.inf and self.hull in HULLS
        if not (sound and self.friction >= 0 and self.torsion >= 0 and self.edges >= 3):
            raise DexgraspError(
                f"origin of 3 numbers, scale > 0, friction >= 0, torsion >= 0, edges >= 3, hull one of {HULLS}",
                str(asdict(self)),
                "mend the wrench model",
            )

    @classmethod
    def about(
        cls, body: Body, hand: Hand, friction: float = 0.5, edges: int = 8, torsion: float | None = None
    ) -> "WrenchModel":
        """Return the model of a hand's grasps of a body: torques about its centre of mass; torsion None, the hand's."""
        torsion = torsion_of(fewest_fingers(hand), torsion)
        return cls(tuple(body.com), body.radius, friction, edges, torsion)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> "WrenchModel":
        """Return the model that `as_dict` told."""
        return cls(**fields)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self) | {"origin": list(self.origin)}

    @property
    def per_contact(self) -> int:
        """Wrenches of one contact."""
        return len(cone_edges(self.edges, self.torsion > 0))

    def wrenches(self, contacts: Array, normals: Array) -> Array:
        """Return wrenches (N, F * per_contact, 6) of contacts (N, F, 3), m, with outward unit normals (N, F, 3)."""
        return quality.wrenches(
            contacts, normals, np.array(self.origin), self.scale, self.friction, self.edges, self.torsion
        )

    def epsilon(self, contacts: Array, normals: Array, threshold: float | None = None) -> "Quality":
        """Return exact epsilon (N,) with this model; below a threshold it may be told as 0, which is faster.

        Here and below, contacts of NaN are of fingers that do not touch, and the figure is of the others alone.
        """

        def figure(points: Array, outward: Array) -> Array:
            return quality.epsilon(self.wrenches(points, outward), threshold, self._summed(points))

        return Quality(_by_number(figure, contacts, normals), self, "epsilon", threshold)

    def reaches(self, contacts: Array, normals: Array, threshold: float) -> Array:
        """Return whether epsilon >= threshold (N,): the fastest filter."""

        def figure(points: Array, outward: Array) -> Array:
            return quality.reaches(self.wrenches(points, outward), threshold, self._summed(points))

        return _by_number(figure, contacts, normals) > 0

    def volume(self, contacts: Array, normals: Array) -> "Quality":
        """Return the volume (N,) of the wrench hull with this model."""

        def figure(points: Array, outward: Array) -> Array:
            return quality.volume(self.wrenches(points, outward), self._summed(points))

        return Quality(_by_number(figure, contacts, normals), self, "volume")

    def _summed(self, contacts: Array) -> int:
        return contacts.shape[1] if self.hull == "linf" else 0


def _by_number(figure: Callable[[Array, Array], Array], contacts: Array, normals: Array) -> Array:
    """Return a figure (N,) of the contacts (N, F, 3) that are not NaN, all grasps with equally many at once."""
    touched = ~(torch.as_tensor(contacts) + torch.as_tensor(normals)).isnan().any(dim=-1).cpu().numpy()
    if touched.all():
        return figure(contacts, normals)
    first, number = np.argsort(~touched, axis=1, kind="stable"), touched.sum(axis=1)
    result = np.zeros(len(contacts))
    for size in np.unique(number[number > 0]).tolist():
        rows = np.flatnonzero(number == size)
        chosen = rows[:, None], first[rows, :size]
        result[rows] = torch.as_tensor(figure(contacts[chosen], normals[chosen])).cpu().numpy()
    return result if isinstance(contacts, np.ndarray) else torch.from_numpy(result).to(contacts)


@dataclass(frozen=True, eq=False)
class Quality:
    """Figures of grasps and what they are about."""

    values: Array
    """(N,)"""
    model: WrenchModel
    metric: Literal["epsilon", "volume"] = "epsilon"
    threshold: float | None = None
    """Values below it may be told as 0."""

    def as_dict(self) -> dict[str, Any]:
        """Return what stands beside stored values: metric, threshold and model, plain for JSON."""
        return {"metric": self.metric, "threshold": self.threshold, "model": self.model.as_dict()}
