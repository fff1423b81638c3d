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
from dexgrasp.grasps import Grasps
from dexgrasp.representation import Representation, Targets
from dexgrasp.scene import View

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
    """Pairs of grasp and finger tried at each point, best quality first."""


@dataclass(frozen=True)
class Labels(Batch):
    """The points of a view that lie near a contact; all others are not graspable."""

    point: Int[Tensor, "K"]
    """Index in the view, ascending."""
    finger: Int[Tensor, "K"]
    """1..F: the finger that touches here."""
    parameters: Float[Tensor, "K P"]
    """The grasp in the representation's numbers."""
    quality: Float[Tensor, "K"]
    """Of the grasp that is told here; 0 where none is true."""
    true: Bool[Tensor, "K"]
    """False: no grasp that touches near here could be told from here."""
    grasp: Int[Tensor, "K"]
    """Index of the grasp among those that were given."""

    def targets(self, count: int, *, failed: str = "negative") -> Targets:
        """Return the targets of all `count` points of the view.

        ``failed="negative"`` makes points whose grasps cannot be told from there not graspable; ``"ignored"`` leaves
        them out of the loss.
        """
        if failed not in ("negative", "ignored"):
            raise ValueError(f"failed: expected 'negative' or 'ignored', found {failed!r}")
        kept = self if failed == "ignored" else self[self.true]
        finger = torch.zeros(count, dtype=torch.long)
        parameters = self.parameters.new_zeros(count, self.parameters.shape[1])
        quality = self.quality.new_zeros(count)
        encodable = torch.ones(count, dtype=torch.bool)
        where = kept.point.long()
        finger[where], parameters[where] = kept.finger.long(), kept.parameters
        quality[where], encodable[where] = kept.quality, kept.true
        return Targets(finger, parameters, quality, encodable)


@torch.no_grad()
def label(
    view: View,
    grasps: Grasps,
    representation: Representation,
    check: Check,
    settings: LabelSettings | None = None,
) -> Labels:
    """Label the points of a view with grasps of its scene (camera frame; `grasps.object` as `view.instance`).

    At each point, the pairs of a grasp and a finger whose contact is near and whose normal agrees are tried, best
    quality first: told at the point with its estimated normal, decoded, checked. The first that is true labels it.
    """
    settings = settings or LabelSettings()
    fingers = grasps.contacts.shape[1]
    point, contact = near_pairs(view, grasps, settings)
    best_first = np.lexsort((contact, -grasps.quality.numpy()[contact // fingers], point))
    contact = torch.from_numpy(contact[best_first])
    runs = np.unique(point[best_first], return_index=True, return_counts=True)
    points, start, size = (torch.from_numpy(part) for part in runs)

    found = Labels(
        point=points,
        finger=contact[start] % fingers + 1,
        parameters=view.points.new_zeros(len(points), representation.size),
        quality=view.points.new_zeros(len(points)),
        true=torch.zeros(len(points), dtype=torch.bool),
        grasp=contact[start] // fingers,
    )
    for turn in range(settings.tries):
        row = (~found.true & (turn < size)).nonzero().flatten()
        if not len(row):
            break
        pair = contact[start[row] + turn]
        original = grasps[pair // fingers].replace(finger=pair % fingers)
        at, normals = view.points[points[row]], view.normals[points[row]]
        targets = representation.encode(at, normals, original)
        told = representation.decode(at, normals, representation.as_prediction(targets))
        true, quality = torch.zeros(len(row), dtype=torch.bool), torch.zeros_like(targets.quality)
        can = targets.encodable
        true[can], quality[can] = check(told[can], original[can])
        row, targets, pair, quality = row[true], targets[true], pair[true], quality[true]
        found.finger[row], found.parameters[row], found.quality[row] = targets.finger, targets.parameters, quality
        found.true[row], found.grasp[row] = True, pair // fingers
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
