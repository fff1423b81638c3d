"""What makes a generated grasp good, by the true object's surface; and what makes a critic one of Wasserstein's."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.distance import DistanceField
from dexgrasp.geometry import inverse


def surface_distance(
    points: Float[Tensor, "B P 3"],
    frame_T_object: Float[Tensor, "B 4 4"],
    objects: Sequence[int],
    field: Callable[[int], DistanceField],
) -> Float[Tensor, "B P"]:
    """Return signed distances of points (m) to the surface of each row's object; gradients are its normals."""
    motion = inverse(frame_T_object)
    inside = points @ motion[:, :3, :3].mT + motion[:, None, :3, 3]
    foot, normal = torch.empty_like(inside), torch.empty_like(inside)
    numbers = torch.tensor(objects)
    for number in sorted(set(objects)):
        rows = (numbers == number).nonzero().flatten()
        _, feet, outward = field(number).nearest(inside[rows].detach().flatten(0, 1))
        foot[rows], normal[rows] = feet.reshape(len(rows), -1, 3), outward.reshape(len(rows), -1, 3)
    away = inside - foot.detach()
    # Where the nearest point lies on an edge, the way to it is no face's normal: the sign alone is the normal's.
    side = torch.where((away.detach() * normal).sum(-1) < 0, -1.0, 1.0)
    return side * (away.square().sum(-1) + 1e-12).sqrt()


def contact(tips: Float[Tensor, "B F T"], touching: Bool[Tensor, "B F"]) -> Float[Tensor, "B"]:
    """Return how far fingertips that shall touch are off on average, m; `tips` are the distances of their points."""
    off = tips.amin(-1).abs() * touching
    return off.sum(-1) / touching.sum(-1).clamp(min=1)


def penetration(distances: Float[Tensor, "B P"], heights: Float[Tensor, "B P"]) -> Float[Tensor, "B"]:
    """Return the summed depth of a hand's points in the object and in the table, m."""
    return F.relu(-distances).sum(-1) + F.relu(-heights).sum(-1)


def orientation(palm: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B"]:
    """Return 1 - cosine between the approach direction and the way from the palm to the object's middle, the origin."""
    return 1 - F.cosine_similarity(palm[:, :3, 2], -palm[:, :3, 3], dim=1)


def gradient_penalty(
    critic: Callable[[Tensor], Tensor], real: Float[Tensor, "B N"], made: Float[Tensor, "B N"], mix: Float[Tensor, "B"]
) -> Tensor:
    """Return how far the critic's slope between true and generated is from 1 (Gulrajani et al. 2017)."""
    between = (made + mix.unsqueeze(1) * (real - made)).detach().requires_grad_()
    (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    return ((slope.square().sum(1) + 1e-12).sqrt() - 1).square().mean()
