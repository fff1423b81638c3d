"""The Backbone interface: a cloud becomes a feature per seed point."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

Plan = dict[str, Tensor]
"""Index tensors of one cloud (or, stacked, of a batch). ``seeds`` (M,) int64 is always there."""


class Backbone(nn.Module, ABC):
    """Point features. `plan` holds everything that depends on positions only and has no gradient (farthest point
    sampling, neighbours), so that a data loader can make it once per view and cache it."""

    channels: int
    """Size C of a feature."""
    farthest_first: bool = False
    """Whether `seeds` are `farthest_points` of the cloud, in their order: then they serve others who need some, too."""

    @abstractmethod
    def plan(self, points: Float[Tensor, "N 3"]) -> Plan:
        """Return the index tensors of one cloud, on the CPU. `seeds` says at which points features are given.

        The result does not depend on the order of the points (up to their renaming).
        """

    def plans(self, points: Float[Tensor, "B N 3"]) -> Plan:
        """Return the stacked plans of a batch of clouds, on their device; here one by one, by `plan`."""
        plans = [self.plan(cloud) for cloud in points]
        return {name: torch.stack([plan[name] for plan in plans]).to(points.device) for name in plans[0]}

    @abstractmethod
    def forward(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None = None
    ) -> tuple[Float[Tensor, "B M C"], Int[Tensor, "B M"]]:
        """Return features and the indices of the seed points they belong to.

        `cloud` is position (m, any frame) and unit normal; `plan` is the stacked plans of the batch, made here
        where None.
        """
