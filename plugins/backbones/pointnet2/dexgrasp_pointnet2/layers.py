"""Set abstraction and feature propagation on flattened batches: the rows of all clouds, one below the other."""

import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp.heads import Layers
from dexgrasp_pointnet2.interpolation import interpolated
from dexgrasp_pointnet2.pooling import ball_max

FEW = 16
"""So few columns are multiplied as `FewColumns`."""


class FewColumns(nn.Linear):
    """A linear layer without bias on few columns, such as positions.

    Where it trains its weight is laid out input by input: torch then finds its gradient, a product of two long thin
    matrices, several times faster on a CPU.
    """

    def __init__(self, columns: int, out: int) -> None:
        super().__init__(columns, out, bias=False)

    def across(self) -> Float[Tensor, "C D"]:
        """Return the matrix by which rows are multiplied."""
        return self.weight.T.contiguous() if self.training else self.weight.T

    def forward(self, rows: Float[Tensor, "N C"]) -> Float[Tensor, "N D"]:
        return rows.mm(self.across())


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Return linear layers from widths[0] to widths[-1], each with batch norm and ReLU; no bias before a norm."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        linear = FewColumns(before, after) if before < FEW else nn.Linear(before, after, bias=False)
        layers += [linear, nn.BatchNorm1d(after), nn.ReLU(inplace=True)]
    return Layers(*layers)


class SetAbstraction(nn.Module):
    """The features of a ball of points become one feature at its centre.

    Grouped, as published: max over the ball of mlp([x - c, f]). The first linear layer is split into W [x, f], once
    per point, and W_x c, once per centre: the same numbers, neighbours times cheaper.
    Factorised: the max is taken right behind that first layer, the rest of the MLP runs once per centre, with a
    residual connection where sizes allow. Not the same function, but the same parameters, and several times faster.
    """

    def __init__(self, channels: int, widths: Sequence[int], factorised: bool) -> None:
        super().__init__()
        self.factorised = factorised
        self.residual = factorised and len(widths) > 1 and widths[0] == widths[-1]
        self.position = FewColumns(3, widths[0])
        self.feature = nn.Linear(channels, widths[0], bias=False)
        self.norm = nn.BatchNorm1d(widths[0])
        self.rest = mlp(widths)

    def forward(
        self,
        points: Float[Tensor, "N 3"],
        features: Float[Tensor, "N C"],
        centres: Float[Tensor, "M 3"],
        group: Int[Tensor, "M K"],
    ) -> Float[Tensor, "M D"]:
        # Positions of a scene differ by millimetres around a metre: half precision would lose them.
        with torch.autocast(points.device.type, enabled=False):
            across = self.position.across()
            rows = self.feature(features.to(points)).addmm_(points, across)
            rows = ball_max(rows, group) if self.factorised else F.embedding(group, rows)
            rows = rows.sub_(centres.mm(across).reshape(len(group), *[1] * (rows.dim() - 2), -1)).flatten(0, -2)
        rows = F.relu_(self.norm(rows))
        if self.factorised:
            return rows + self.rest(rows) if self.residual else self.rest(rows)
        return self.rest(rows).unflatten(0, group.shape).max(dim=1).values


class FeaturePropagation(nn.Module):
    """Interpolate coarse features onto finer points (3 nearest, inverse squared distance), join theirs, MLP.

    The first linear layer commutes with the interpolation, so its coarse half runs on the coarse points.
    """

    def __init__(self, coarse: int, skip: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.coarse = nn.Linear(coarse, widths[0], bias=False)
        self.skip = nn.Linear(skip, widths[0], bias=False) if skip else None
        self.norm = nn.BatchNorm1d(widths[0])
        self.rest = mlp(widths)

    def forward(
        self,
        coarse_points: Float[Tensor, "M 3"],
        coarse: Float[Tensor, "M C"],
        points: Float[Tensor, "N 3"],
        skip: Float[Tensor, "N D"],
        nearest: Int[Tensor, "N K"],
    ) -> Float[Tensor, "N E"]:
        squared = (coarse_points[nearest] - points[:, None]).square().sum(-1)
        weights = 1 / (1e8 * squared + 1)  # 1 / (squared + 1e-8): as a term of its own, ONNX drops 1e-8
        weights = weights / weights.sum(1, keepdim=True)
        rows = interpolated(self.coarse(coarse).to(weights), nearest, weights)
        if self.skip is not None:
            rows = rows + self.skip(skip)
        return self.rest(F.relu_(self.norm(rows)))
