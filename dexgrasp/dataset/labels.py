"""Labels of a view: which visible points are graspable, and what the network shall say there (METHOD section 2)."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.representation import Representation, Targets
from dexgrasp.sampling import farthest_points
from dexgrasp.scene import View
from dexgrasp.support import support

Check = Callable[[Grasps, Grasps], tuple[Bool[Tensor, "N"], Float[Tensor, "N"]]]
"""Told and original grasps -> which told ones are true, and their quality; `Truth.holds`, or one that asks more."""


@dataclass(frozen=True)
class LabelSettings:
    """Which contacts may label which points."""

    distance: float = 0.005
    """Farthest that a labelled contact may be from the point, m."""
    angle: float = math.radians(20)
    """Most that the contact's normal may differ from the point's estimated one, rad."""
    tries: int = 12
    """Pairs of grasp and finger tried at each point, best first."""
    worth: str = "epsilon"
    """What makes a grasp good: `capacity`, the weight that it holds (`load_capacity.lifts`), or `epsilon`."""
    support: bool = True
    """Best is the grasp with the most worth among grasps like it (`support`), else the one of most worth."""
    doubt: float | None = None
    """Among grasps like it the mean counts, as if so many more were worth nothing; None: the sum."""
    points: int | None = 2048
    """Only so many points of a view are labelled: the farthest-point samples, among which backbones choose their seeds
    in the same order; None: all."""

    def __post_init__(self) -> None:
        if self.worth not in ("capacity", "epsilon"):
            remedy = "set dataset.labels.points.worth to one of them"
            raise DexgraspError("labels.points.worth: capacity or epsilon", repr(self.worth), remedy)


@dataclass(frozen=True)
class Labels(Batch):
    """What is known of K points of a view."""

    point: Int[Tensor, "K"]
    """Index in the view, ascending."""
    finger: Int[Tensor, "K"]
    """0: no contact is near; 1..F: the finger that touches here."""
    parameters: Float[Tensor, "K P"]
    """The grasp in the representation's numbers."""
    quality: Float[Tensor, "K"]
    """Of the grasp that is told here; 0 where none is true."""
    true: Bool[Tensor, "K"]
    """Whether a grasp that touches near here was told from here and still is one; False where `finger` is 0."""
    grasp: Int[Tensor, "K"]
    """Index of the grasp among those that were given; -1 where `finger` is 0."""

    def targets(self, count: int, *, failed: str = "negative") -> Targets:
        """Return the targets of all `count` points of the view.

        ``failed="negative"`` makes points whose grasps cannot be told from there not graspable; ``"ignored"`` leaves
        them out of the loss, as points of which nothing is known always are (`finger` 1, not encodable).
        """
        if failed not in ("negative", "ignored"):
            raise ValueError(f"failed: expected 'negative' or 'ignored', found {failed!r}")
        where, finger = self.point.long(), self.finger.long()
        if failed == "negative":
            finger = torch.where(self.true, finger, 0)
        targets = Targets(
            finger=torch.ones(count, dtype=torch.long),
            parameters=self.parameters.new_zeros(count, self.parameters.shape[1]),
            quality=self.quality.new_zeros(count),
            encodable=torch.zeros(count, dtype=torch.bool),
        )
        targets.finger[where], targets.parameters[where] = finger, self.parameters
        targets.quality[where], targets.encodable[where] = self.quality, self.true | (finger == 0)
        return targets


@torch.no_grad()
def label(
    view: View,
    grasps: Grasps,
    representation: Representation,
    check: Check,
    settings: LabelSettings | None = None,
    worth: Float[Tensor, "G"] | None = None,
) -> Labels:
    """Label the points of a view with grasps of its scene (camera frame; `grasps.object` as `view.instance`).

    At each point, the pairs of a grasp and a finger whose contact is near and whose normal agrees are tried, those of
    most `worth` first (None: the grasps' quality): told at the point with its estimated normal, decoded, checked. The
    first that is true labels it.
    """
    settings = settings or LabelSettings()
    fingers = grasps.contacts.shape[1]
    chosen = torch.arange(len(view))
    if settings.points is not None and settings.points < len(view):
        chosen = farthest_points(view.points, settings.points).sort().values
    asked = View(view.points[chosen], view.normals[chosen], view.instance[chosen], view.world_T_camera)
    point, touched = near_pairs(asked, grasps, settings)
    worth = grasps.quality if worth is None else worth
    worth = support(grasps, worth, settings.doubt) if settings.support else worth
    best_first = np.lexsort((touched, -worth.numpy()[touched // fingers], point))
    contact = torch.from_numpy(touched[best_first])
    size = torch.from_numpy(np.bincount(point, minlength=len(asked)))
    start = size.cumsum(0) - size
    found = Labels(
        point=chosen.int(),
        finger=torch.zeros(len(asked), dtype=torch.int8),
        parameters=view.points.new_zeros(len(asked), representation.size),
        quality=view.points.new_zeros(len(asked)),
        true=torch.zeros(len(asked), dtype=torch.bool),
        grasp=torch.full((len(asked),), -1, dtype=torch.int32),
    )
    near = size > 0
    found.finger[near] = (contact[start[near]] % fingers + 1).to(torch.int8)
    found.grasp[near] = (contact[start[near]] // fingers).int()
    for turn in range(settings.tries):
        row = (~found.true & (turn < size)).nonzero().flatten()
        if not len(row):
            break
        pair = contact[start[row] + turn]
        original = grasps[pair // fingers].replace(finger=pair % fingers)
        at, normals = asked.points[row], asked.normals[row]
        targets = representation.encode(at, normals, original)
        told = representation.decode(at, normals, representation.as_prediction(targets))
        true, quality = torch.zeros(len(row), dtype=torch.bool), torch.zeros_like(targets.quality)
        can = targets.encodable
        true[can], quality[can] = check(told[can], original[can])
        row, targets, pair, quality = row[true], targets[true], pair[true], quality[true]
        found.finger[row], found.grasp[row] = targets.finger.to(torch.int8), (pair // fingers).int()
        found.parameters[row], found.quality[row], found.true[row] = targets.parameters, quality, True
    return found


def near_pairs(view: View, grasps: Grasps, settings: LabelSettings) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return points and contacts (grasp * F + finger) of one object that are near and face the same way."""
    contacts = grasps.contacts.flatten(0, 1).double().numpy()
    outward = grasps.normals.flatten(0, 1).double().numpy()
    owner = grasps.object.repeat_interleave(grasps.contacts.shape[1]).numpy()
    owner = np.where(np.isfinite(contacts).all(axis=1), owner, -1)
    cloud, normals = view.points.double().numpy(), view.normals.double().numpy()
    instance = view.instance.numpy()
    found = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for body in np.intersect1d(instance[instance >= 0], owner[owner >= 0]):
        own, touched = (instance == body).nonzero()[0], (owner == body).nonzero()[0]
        near = cKDTree(cloud[own]).sparse_distance_matrix(
            cKDTree(contacts[touched]), settings.distance, output_type="ndarray"
        )
        point, contact = own[near["i"]], touched[near["j"]]
        agree = (normals[point] * outward[contact]).sum(axis=1) >= math.cos(settings.angle)
        found.append((point[agree], contact[agree]))
    point, contact = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return point, contact
