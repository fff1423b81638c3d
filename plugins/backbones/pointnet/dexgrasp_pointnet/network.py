"""Point features from the point itself and the maximum over the whole cloud."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp.backbone import Backbone, Plan
from dexgrasp.sampling import farthest_points


class PointNet(Backbone):
    """PointNet for segmentation, without transform nets; features at farthest points.

    Args:
        points: number of seeds.
        local: layer sizes of each point's own feature.
        summary: further layer sizes, before the maximum over the cloud.
        head: layer sizes on [own feature, maximum] at the seeds.
    """

    farthest_first = True

    def __init__(
        self,
        points: int = 2048,
        local: Sequence[int] = (64, 64),
        summary: Sequence[int] = (128, 256),
        head: Sequence[int] = (256, 128),
    ) -> None:
        super().__init__()
        self.points = points
        self.local = _mlp((6, *local))
        self.summary = _mlp((local[-1], *summary))
        # One linear layer on [own, maximum], its second half once per cloud.
        self.own = nn.Linear(local[-1], head[0], bias=False)
        self.whole = nn.Linear(summary[-1], head[0], bias=False)
        self.norm = nn.BatchNorm1d(head[0])
        self.head = _mlp(head)
        self.channels = head[-1]

    def plan(self, points: Float[Tensor, "N 3"]) -> Plan:
        return {"seeds": farthest_points(points, min(self.points, len(points)))}

    def forward(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None = None
    ) -> tuple[Float[Tensor, "B M C"], Int[Tensor, "B M"]]:
        if plan is None:
            plan = self.plans(cloud[..., :3])
        seeds = plan["seeds"]
        local = self.local(cloud.flatten(0, 1))
        whole = self.summary(local).unflatten(0, cloud.shape[:2]).amax(dim=1)
        own = torch.take_along_dim(local.unflatten(0, cloud.shape[:2]), seeds[..., None], dim=1)
        rows = (self.own(own) + self.whole(whole)[:, None]).flatten(0, 1)
        return self.head(F.relu(self.norm(rows))).unflatten(0, seeds.shape), seeds


def _mlp(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after, bias=False), nn.BatchNorm1d(after), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
