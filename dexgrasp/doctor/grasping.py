"""The real closing on balls and boxes: can fingertips reach what hands shall hold?"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.dataset.proposals import Approach, Contact, opened
from dexgrasp.dataset.surface import Surface
from dexgrasp.distance import DistanceField
from dexgrasp.doctor.finding import Finding, error, note, warning
from dexgrasp.doctor.solid import closed_by, drawn
from dexgrasp.geometry import axis_angle, inverse
from dexgrasp.geometry import pose as rigid
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.progress import track
from dexgrasp.seeds import stream

SIZES = (0.02, 0.04, 0.06, 0.08, 0.10)
"""Diameters of balls and edges of cubes, m."""
CANDIDATES = 512
"""Hands tried on each, in each of three ways."""
PARTS = 16
"""Of closing, at which fingertips are an object apart."""
DEPTH = 0.001
"""Hands may be so deep in the object, m."""
SELDOM = 0.01
"""A smaller share of hands that hold something is next to none."""


@dataclass(frozen=True, eq=False)
class Reach:
    """What became of the hands that were closed on one object; those that began in it are left out."""

    name: str
    tips: Bool[Tensor, "N F"]
    """Which fingertips touched it."""
    links: Bool[Tensor, "N F"]
    """Which fingers touched it with whatever part."""
    opposed: Bool[Tensor, "N"]
    """Whether two fingertips touched it from different sides: more than 90 deg between the normals."""

    @property
    def pairs(self) -> float:
        """Share of hands that touched it with two fingertips from different sides."""
        return float(self.opposed.double().mean()) if len(self.opposed) else 0.0

    @property
    def most(self) -> int:
        """Largest number of fingertips that touched it at once."""
        return int(self.tips.sum(dim=1).max()) if len(self.tips) else 0


def reaches(hand: Hand) -> list[Reach]:
    """Close a hand on balls and cubes of `SIZES`; kept with the hand. The same hand, the same result."""
    if "_reaches" not in hand.__dict__:
        shape, closer = HandShape(hand), Closer(hand)
        hand.__dict__["_reaches"] = [
            _reach(hand, shape, closer, *item) for item in track(list(_objects()), "closing on balls and boxes")
        ]
    known: list[Reach] = hand.__dict__["_reaches"]
    return known


def fingertips_reach_objects(hand: Hand) -> Iterator[Finding]:
    """Two fingertips can touch balls and boxes of 2 to 10 cm at once, and each fingertip touches some."""
    tried = reaches(hand)
    told = ", ".join(f"{reach.name} {reach.pairs:.1%} ({reach.most} tips)" for reach in tried)
    if max(reach.pairs for reach in tried) < SELDOM:
        by_link = max(float((reach.links.sum(dim=1) >= 2).double().mean()) for reach in tried if len(reach.links))
        yield error(
            hand.name,
            f"closing on balls and boxes of 2 to 10 cm, next to never do two fingertips touch at once: {told}",
            "no grasp can be synthesised, so there is nothing to learn",
            f"fingers touch with other parts in {by_link:.0%}: check link, tip_center and closing_axis of the fingers"
            if by_link > 0.1
            else "check limits, closing directions and palm first: fingers pass by the object, or begin in it",
        )
        return
    for i, finger in enumerate(hand.fingers):
        best = max(float(reach.tips[:, i].double().mean()) for reach in tried if len(reach.tips))
        if best < SELDOM:
            part = max(float(reach.links[:, i].double().mean()) for reach in tried if len(reach.links))
            yield warning(
                finger.name,
                f"its fingertip touches none of the balls and boxes (other parts of the finger do in up to {part:.0%})",
                "grasps in which this finger takes part will hardly be found",
                "check its link, tip_center, closing_axis and closing joints",
            )
    good = [reach.name for reach in tried if reach.pairs >= SELDOM]
    if len(good) < len(tried):
        yield note(
            hand.name,
            f"two fingertips touch {', '.join(good)}; not the others ({told})",
            "objects of other sizes will have no grasps",
            "nothing, if the hand is so small or so large",
        )


def _objects() -> Iterator[tuple[str, trimesh.Trimesh]]:
    for size in SIZES:
        yield f"ball {size * 100:.0f} cm", trimesh.creation.icosphere(3, size / 2)
    for size in SIZES[1::2]:
        yield f"box {size * 100:.0f} cm", trimesh.creation.box((size, size, size))


def _reach(hand: Hand, shape: HandShape, closer: Closer, name: str, mesh: trimesh.Trimesh) -> Reach:
    field = DistanceField.build(mesh, 0.004)
    item = Object(name, name, mesh, (mesh,), "")
    surface = Surface.sample(item, field, 0.004, stream(0, "doctor", name))
    pose, joints = _between(hand)
    poses, postures = [pose], [joints]
    for proposer in (Contact(hand), Approach(hand)):
        draws = proposer.draw(surface, CANDIDATES, stream(0, "doctor", name, type(proposer).__name__))
        pose, joints = proposer.hands(surface, draws)
        poses.append(pose)
        postures.append(joints)
    pose, joints = torch.cat(poses), torch.cat(postures)
    free = shape.object_distance(field, pose, joints) > -DEPTH
    closure = closer.close(field, pose[free], joints[free])
    clean = (closure.penetration <= DEPTH).unsqueeze(1)
    tips = closure.touched & closure.on_tip & clean
    cosines = closure.normals @ closure.normals.transpose(1, 2)  # NaN where a finger touches nothing
    opposed = ((cosines < 0) & tips.unsqueeze(1) & tips.unsqueeze(2)).any(dim=2).any(dim=1)
    return Reach(name, tips, closure.touched & clean, opposed)


def _between(hand: Hand) -> tuple[Float[Tensor, "N 4 4"], Float[Tensor, "N J"]]:
    """Return open hands, object_T_base, that have an object's centre in the middle between two fingertips.

    The object's x axis points from one to the other. Fingers that move together, as a jaw's do, need it there.
    """
    joints = torch.cat([closed_by(hand, part, drawn(hand, CANDIDATES // PARTS)) for part in np.linspace(0, 1, PARTS)])
    tips = hand.fingertips(joints)[..., :3, 3]
    pairs = list(combinations(range(len(hand.fingers)), 2))
    first, second = torch.tensor([pairs[k % len(pairs)] for k in range(len(joints))]).T
    rows = torch.arange(len(joints))
    one, two = tips[rows, first], tips[rows, second]
    x = normalize(two - one, dim=-1)
    # A third of the objects are turned about that axis like the palm, the others by a third and two thirds of a turn.
    palm = hand.base_T_palm[:3, 2] + 1e-3 * torch.randn(3, generator=torch.Generator().manual_seed(0))
    z = normalize(palm - (x @ palm).unsqueeze(-1) * x, dim=-1)
    z = (axis_angle(x, (rows % 3) * (2 * torch.pi / 3)) @ z.unsqueeze(-1)).squeeze(-1)
    base_T_object = rigid(torch.stack([x, torch.linalg.cross(z, x), z], dim=-1), (one + two) / 2)
    return inverse(base_T_object), opened(hand, joints)
