"""Numbers told as bin + residual in units of its width, as joints are (METHOD section 2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.heads import CERTAIN


@dataclass(frozen=True)
class Bins:
    """`count` bins from `lower` on; numbers beyond the ends are told by residuals beyond +-1/2, or wrap."""

    lower: float
    width: float
    count: int
    wraps: bool = False

    def split(self, values: Float[Tensor, "N"]) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
        """Return bin and residual."""
        steps = (values - self.lower) / self.width
        steps = torch.remainder(steps, self.count) if self.wraps else steps
        index = steps.floor().long().clamp(0, self.count - 1)
        return index, steps - index - 0.5

    def join(self, told: Float[Tensor, "N 2 B"]) -> Float[Tensor, "N"]:
        """Return what the likeliest bin and its residual say."""
        index = told[:, 0].argmax(-1, keepdim=True)
        return self.lower + (index + 0.5 + told[:, 1].gather(-1, index)).squeeze(-1) * self.width

    def loss(self, told: Float[Tensor, "N 2 B"], values: Float[Tensor, "N"], huber: float) -> Float[Tensor, "N"]:
        """Return cross-entropy on the bin + Huber on the residual of the true bin."""
        index, residual = self.split(values)
        rest = told[:, 1].gather(-1, index.unsqueeze(-1)).squeeze(-1).to(residual)
        known = F.smooth_l1_loss(rest, residual, reduction="none", beta=huber)
        return F.cross_entropy(told[:, 0], index, reduction="none") + known

    def as_prediction(self, values: Float[Tensor, "N"]) -> Float[Tensor, "N 2 B"]:
        """Return logits and residuals that say exactly `values`."""
        index, residual = self.split(values)
        logits = CERTAIN * F.one_hot(index, self.count).to(values)
        return torch.stack([logits, residual.unsqueeze(-1).expand_as(logits)], dim=1)
