"""Objects become grasps: propose, look ahead, close, judge, thin (METHOD section 4)."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.contact_frame import place, project
from dexgrasp.dataset.search import Search
from dexgrasp.dataset.spread import coverage
from dexgrasp.dataset.surface import Surface
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.seeds import stream

LITTLE = 0.001
"""A round that brings less than this part of the target has brought nothing."""
LEVER = 0.1
"""Turning the base by an angle counts as moving it by angle x this (m) when the telling finger is chosen."""
EXACT = 3e-4
"""A grasp is told exactly where the told base lies this near to the true one, m, turns counted as by LEVER."""


@dataclass(frozen=True)
class Summary:
    """What became of the candidates of one object."""

    candidates: int
    rejected: dict[str, int] = field(default_factory=dict)
    """By the first check that failed, in order."""
    valid: int = 0
    """Passed every check."""
    distinct: int = 0
    """Of those, not near-duplicates of a better one."""
    kept: int = 0
    """Of those, what the target asks for."""
    exact: float = 0.0
    """Share of those kept that one of their contacts tells exactly in the 6-D representation (METHOD section 1)."""
    surface: float = 0.0
    directions: float = 0.0
    """What those kept reach, see `dexgrasp.dataset.spread.Coverage`."""
    fingers: dict[str, int] = field(default_factory=dict)
    """How many of those kept touch with so many fingers."""
    model: dict[str, Any] = field(default_factory=dict)
    """What `quality` is about, see `dexgrasp.wrench_model.WrenchModel`; torque origin in the object's frame."""
    note: str = ""
    """Why there are none."""


def synthesize(hand: Hand, item: Object, settings: SynthesisSettings, seed: int) -> tuple[Grasps, Summary]:
    """Return grasps of one object in its own frame (float64), best spread first, and what became of the candidates.

    The fingers that `touching` names touch with their tips, the others are open and clear of the object; nothing
    overlaps by more than `penetration`, epsilon is at least `settings.epsilon`, and hand and object stay apart on the
    straight way back with the fingers opened. `finger` is the one whose contact tells the pose best (METHOD section 1).
    The same seed gives the same grasps.
    """
    body = DistanceField.build(item.mesh)
    surface = Surface.sample(item, body, settings.spacing, stream(seed, "surface", item.name))
    search = Search(hand, item, surface, settings)
    idle = 0
    for number in range(settings.rounds):
        before = search.progress
        search.round(stream(seed, "synthesis", item.name, number))
        idle = 0 if search.progress - before > LITTLE * settings.target else idle + 1
        if search.done or idle == settings.patience:
            break
    found, lost = tell(hand, search.chosen())
    reached = coverage(hand, surface, found)
    exact = float((lost < EXACT).double().mean()) if len(found) else 0.0
    return found, Summary(
        candidates=search.candidates,
        rejected=dict(search.rejected),
        valid=search.valid,
        distinct=len(search.grasps),
        kept=len(found),
        exact=exact,
        surface=reached.surface,
        directions=reached.directions,
        fingers=by_fingers(found),
        model=search.model.as_dict(),
        note=search.note(),
    )


def by_fingers(grasps: Grasps) -> dict[str, int]:
    """Return how many grasps touch with so many fingers, fewest first."""
    numbers, counts = grasps.touching.sum(dim=1).unique(return_counts=True)
    return {str(number): count for number, count in zip(numbers.tolist(), counts.tolist(), strict=True)}


def tell(hand: Hand, grasps: Grasps) -> tuple[Grasps, Float[Tensor, "N"]]:
    """Choose for each grasp the finger whose contact tells its pose best; return it told so, and what is lost (m)."""
    best = torch.full((len(grasps),), torch.inf, dtype=torch.float64)
    finger = grasps.touching.int().argmax(dim=1)
    for number in range(len(hand.fingers)):
        which = torch.full((len(grasps),), number)
        points, normals = grasps.contacts[:, number], grasps.normals[:, number]
        xy, known = project(hand, which, points, normals, grasps.pose, grasps.joints)
        back = place(hand, which, points, normals, xy, grasps.joints)
        moved = torch.linalg.vector_norm((back - grasps.pose)[:, :3, 3], dim=1)
        error = moved + LEVER * rotation_angle(back[:, :3, :3], grasps.pose[:, :3, :3])
        error = torch.where(known, error, torch.inf)
        finger = torch.where(error < best, which, finger)
        best = torch.minimum(error, best)
    return grasps.replace(finger=finger), best
