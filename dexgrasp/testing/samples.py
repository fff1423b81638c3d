"""Random joints, grasps and clouds that the laws are tried on."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from dexgrasp import geometry
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.representation import Representation
from dexgrasp.touching import finger_sets


def joints(hand: Hand, count: int, seed: int = 0) -> Float[Tensor, "N J"]:
    """Return joint vectors drawn uniformly between the limits, float64."""
    share = torch.rand(count, len(hand.joint_names), generator=_generator(seed), dtype=torch.float64)
    return hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])


def motion(count: int, seed: int = 0) -> Float[Tensor, "N 4 4"]:
    """Return random rigid motions, translations of some decimetres."""
    generator = _generator(seed)
    axis = normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    angle = 3 * torch.rand(count, generator=generator, dtype=torch.float64)
    shift = 0.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return geometry.pose(geometry.axis_angle(axis, angle), shift)


Told = tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"], Grasps]
"""Contact point (m) and outward normal of the finger from which each grasp is told, and the grasps."""


def grasps(representation: Representation, count: int, seed: int = 0, lean: float = 0.0) -> Told:
    """Return random grasps, told in turn from each finger, whose fingertip touches a surface.

    Where on its surface it touches is the representation's model of it: `touching`.

    The surface normal lies in the finger's flexion plane and points 10 to 60 deg from the pad's direction towards
    the distal link, where every representation can tell the grasp; `lean` (rad) takes it out of that plane by up to
    that angle. Float64.
    """
    generator, hand = _generator(seed + 1), representation.hand
    posture, pose = joints(hand, count, seed), motion(count, seed + 2)
    finger = torch.arange(count) % len(hand.fingers)
    tip = (pose.unsqueeze(1) @ hand.fingertips(posture))[torch.arange(count), finger]
    u, v, w = tip[:, :3, :3].unbind(-1)
    rise = 0.17 + 0.87 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    side = lean * (2 * torch.rand(count, 1, generator=generator, dtype=torch.float64) - 1)
    normals = side.cos() * (rise.cos() * v + rise.sin() * u) + side.sin() * w
    inward = -geometry.rotate(geometry.inverse(tip), normals)
    points = geometry.transform(tip, representation.tip_contacts(finger, inward))
    quality = torch.rand(count, generator=generator, dtype=torch.float64)
    return points, normals, Grasps.build(pose, posture, len(hand.fingers), finger=finger, quality=quality)


def touching(hand: Hand, finger: Int[Tensor, "N"]) -> Bool[Tensor, "N F"]:
    """Return sets of fingers that the hand can grasp with, in turn, each with the finger from which a grasp is told."""
    sets = finger_sets(hand)
    able = [sets[sets[:, one]] for one in range(len(hand.fingers))]
    return torch.stack([able[one][row % len(able[one])] for row, one in enumerate(finger.tolist())])


def cloud(batch: int, points: int, seed: int = 0) -> Float[Tensor, "B N 6"]:
    """Return views of a table with three balls on it, positions in m with unit normals, float32."""
    generator = _generator(seed)
    table = torch.rand(batch, points // 2, 3, generator=generator) * torch.tensor([0.4, 0.4, 0.0])
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(table)
    centers = torch.rand(batch, 3, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.0]) + 0.05
    ball: Int[Tensor, N] = torch.arange(points - points // 2) % 3
    outward = normalize(torch.randn(batch, len(ball), 3, generator=generator), dim=-1)
    balls = centers[:, ball] + 0.04 * outward
    return torch.cat([torch.cat([table, up], dim=-1), torch.cat([balls, outward], dim=-1)], dim=1)


def seen(count: int, seed: int = 0) -> Float[Tensor, "N 3"]:
    """Return what a camera sees of a table 0.6 m below it and of the near halves of three balls on it, m, float32."""
    generator = _generator(seed)
    direction = normalize(torch.randn(count, 3, generator=generator), dim=1)
    direction[:, 2] = -direction[:, 2].abs()
    centers = torch.tensor([[0.0, 0.0, 0.56], [0.12, 0.05, 0.56], [-0.1, 0.08, 0.56]])
    balls = centers[torch.randint(3, (count,), generator=generator)] + 0.04 * direction
    table = torch.rand(count, 3, generator=generator) * torch.tensor([0.5, 0.5, 0.0])
    table = table + torch.tensor([-0.25, -0.25, 0.6])
    return torch.where(torch.rand(count, 1, generator=generator) < 0.5, balls, table)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
