"""How likely a proposed grasp is to lift: a second opinion on what the representation's heads have told."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexgrasp.geometry import transform
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import mlp
from dexgrasp.sampling import farthest_points

COARSE, NEAREST = 512, 64
"""Of so many points, spread evenly over the scene, a grasp is judged by the ones nearest to the middle of its tips."""
REACH = 0.1
"""Offsets and heights (m) in units of this are numbers of order one."""


class Scorer(nn.Module):
    """Logit of the probability that a grasp lifts, from the point's feature, the grasp, and what lies about the hand.

    Labels say which points some known grasp touches; they do not say whether what the network tells there is any good.
    This is trained on exactly that: on the network's own grasps, closed on the true objects.

    Args:
        hand: whose grasps they are.
        channels: size of a point feature.
        choices: number of answers of the heads that it chooses from at each point.
        most: number of points, the most graspable as the heads think, whose grasps it looks at.
        hidden: widths of the hidden layers.
        around: widths of the layers on each point about the hand, whose maximum is then taken (PointNet).
    """

    def __init__(
        self,
        hand: Hand,
        channels: int,
        choices: int = 1,
        most: int = 640,
        hidden: Sequence[int] = (256, 128),
        around: Sequence[int] = (32, 64),
    ) -> None:
        super().__init__()
        self.hand, self.choices, self.most = hand, choices, most
        self.options: dict[str, Any] = {
            "choices": choices,
            "most": most,
            "hidden": list(hidden),
            "around": list(around),
        }
        self.around = mlp(7, around[:-1], around[-1])
        self.layers = mlp(channels + around[-1] + 13 + len(hand.joint_names), hidden, 1)

    def forward(
        self,
        features: Float[Tensor, "N C"],
        at: Float[Tensor, "N 6"],
        grasps: Grasps,
        around: Float[Tensor, "N K 7"],
    ) -> Float[Tensor, "N"]:
        """Return N logits; `at` is point (m) and normal where each grasp is told, level frame; `around` see below."""
        offset = (grasps.pose[:, :3, 3] - at[:, :3]) / REACH
        turned = grasps.pose[:, :3, :2].flatten(1)
        near = self.around(around.to(features).flatten(0, 1)).unflatten(0, around.shape[:2]).amax(dim=1)
        seen = [features, near, offset, turned, at[:, 3:], at[:, 2:3] / REACH, grasps.joints]
        return self.layers(torch.cat([part.to(features) for part in seen], dim=1)).squeeze(1)


def coarse_points(cloud: Float[Tensor, "N 6"], count: int = COARSE) -> Float[Tensor, "Q 6"]:
    """Return `count` points that are spread evenly over a cloud (farthest-point samples); more begin with fewer."""
    return cloud[farthest_points(cloud[:, :3].cpu(), min(count, len(cloud))).to(cloud.device)]


def surroundings(hand: Hand, grasps: Grasps, points: Float[Tensor, "Q 6"]) -> Float[Tensor, "N K 7"]:
    """Return the `points` about each hand: position and normal in its palm's frame, height in the level one; scaled."""
    points = points.to(grasps.pose)
    middle = transform(grasps.pose, hand.fingertips(grasps.joints)[..., :3, 3].mean(dim=1).to(grasps.pose))
    nearest = torch.cdist(middle, points[:, :3]).topk(min(NEAREST, len(points)), largest=False).indices
    positions, normals = points[nearest].split(3, dim=-1)
    palm = grasps.pose @ hand.base_T_palm.to(grasps.pose)
    local = (positions - palm[:, None, :3, 3]) @ palm[:, :3, :3] / REACH
    return torch.cat([local, normals @ palm[:, :3, :3], positions[..., 2:] / REACH], dim=-1)
