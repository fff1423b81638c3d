"""How likely a proposed grasp is to lift: a second opinion on what the representation's heads have told."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import Layers, mlp
from dexgrasp.surroundings import COARSE, FINE, NEAREST, REACH, Seen, look

PIECE = 32
"""Hands whose surroundings are looked at together in evaluation."""


WAY = (64, 32)
"""Widths of the layers on what a fingertip meets on its way."""


class Scorer(nn.Module):
    """Logit of the probability that a grasp lifts, from the point's feature, the grasp, and what lies about the hand.

    Whether it lifts is decided where fingers meet the object: each sees, in its own frame, what is nearest on its way.

    Labels say which points some known grasp touches; they do not say whether what the network tells there is any good.
    This is trained on exactly that: on the network's own grasps, closed on the true objects.

    Args:
        hand: whose grasps they are.
        channels: size of a point feature.
        choices: number of answers of the heads that it chooses from at each point.
        most: number of points, the most graspable as the heads think, whose grasps it looks at.
        hidden: widths of the hidden layers.
        around: widths of the layers on each point about the hand, whose maximum is then taken (PointNet).
        sweep: where on its way each fingertip looks for the nearest point, see `dexgrasp.surroundings.swept`; none: it
            does not.
        along: at which places of the distal link it does so, likewise.
        upright: what was done to the grasps whose outcome it has learnt, see `dexgrasp.selection.Selection`, rad.
        raised: likewise, m.
    """

    def __init__(
        self,
        hand: Hand,
        channels: int,
        choices: int = 3,
        most: int = 256,
        hidden: Sequence[int] = (256, 128),
        around: Sequence[int] = (32, 64),
        sweep: Sequence[float] = (),
        along: Sequence[float] = (0.0,),
        upright: float = 0.0,
        raised: float = 0.0,
    ) -> None:
        super().__init__()
        self.hand, self.choices, self.most = hand, choices, most
        self.options: dict[str, Any] = {
            "choices": choices,
            "most": most,
            "hidden": list(hidden),
            "around": list(around),
            "sweep": list(sweep),
            "along": list(along),
            "upright": upright,
            "raised": raised,
        }
        self.around = mlp(7, around[:-1], around[-1])
        self.sweep, self.along = tuple(sweep), tuple(along)
        met = 7 * len(sweep) * len(along)
        self.way = nn.Sequential(nn.Linear(met, WAY[0]), nn.ReLU(), nn.Linear(*WAY), nn.ReLU()) if sweep else None
        self.spread = FINE if sweep else COARSE
        """Number of `coarse_points` at which it looks."""
        felt = len(hand.fingers) * WAY[-1] if sweep else 0
        self.layers = mlp(channels + around[-1] + felt + 13 + len(hand.joint_names), hidden, 1)

    def look(self, grasps: Grasps, points: Float[Tensor, "Q 6"]) -> Seen:
        """Return what it sees of a scene's `coarse_points`, `self.spread` of them."""
        return look(self.hand, grasps, points, self.sweep, self.along)

    def forward(
        self,
        features: Float[Tensor, "M C"],
        at: Float[Tensor, "N 6"],
        grasps: Grasps,
        around: Float[Tensor, "N K 7"],
        swept: Float[Tensor, "N F S 7"],
    ) -> Float[Tensor, "N"]:
        """Return N logits; `at` is point (m) and normal where each grasp is told, level frame; the rest is of `look`.

        Features of M points, of each of which N / M answers are judged: all points' first, all points' second, ...
        """
        offset = (grasps.pose[:, :3, 3] - at[:, :3]) / REACH
        turned = grasps.pose[:, :3, :2].flatten(1)
        near = torch.cat([piece.amax(dim=1) for piece in self._pieces(self.around, around.to(features))])
        seen = [near, offset, turned, at[:, 3:], at[:, 2:3] / REACH, grasps.joints]
        if self.way is not None:
            seen.append(self.way(swept.to(features).flatten(2)).flatten(1))
        own = torch.cat([part.to(features) for part in seen], dim=1)
        return self.layers(features, own).squeeze(1)

    def _pieces(self, layers: Layers, rows: Float[Tensor, "N K 7"]) -> Iterator[Float[Tensor, "_ K D"]]:
        """Yield what layers make of the points about each of N places, piece by piece where that is quicker."""
        each, every = rows.shape[1], rows.flatten(0, 1)
        if self.training or torch.compiler.is_compiling() or rows.device.type != "cpu":
            pieces = iter([layers(every)])
        else:
            pieces = layers.in_pieces(every.split(max(PIECE * NEAREST // each, 1) * each))  # that stay in the cache
        return (piece.unflatten(0, (-1, each)) for piece in pieces)

    @torch.no_grad()
    def calibrate(self, logits: Float[Tensor, "N"], came: Float[Tensor, "N"]) -> None:
        """Make what is told come true (1 or 0) as often as it says, by `platt`; the order of grasps stays."""
        slope, shift = platt(logits, came)
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(slope)
        last.bias.mul_(slope).add_(shift)


def platt(logits: Float[Tensor, "N"], came: Float[Tensor, "N"]) -> tuple[float, float]:
    """Return slope (positive) and shift that turn logits into those of probabilities that come true (Platt 1999).

    Newton's method on the likelihood of slope * logit + shift, with one success and one failure more at a logit of 0
    so that it has an end where all come true.
    """
    x = torch.cat([logits.double(), logits.new_zeros(2).double()])
    y = torch.cat([came.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    design, found = torch.stack([x, torch.ones_like(x)], dim=1), torch.tensor([1.0, 0.0], dtype=torch.float64)
    for _ in range(50):
        told = (design @ found).sigmoid()
        curved = design.T @ (design * (told * (1 - told))[:, None]) + 1e-6 * torch.eye(2, dtype=torch.float64)
        step = torch.linalg.solve(curved, design.T @ (y - told))
        found = found + step.clamp(-1, 1)
        if step.abs().max() < 1e-9:
            break
    return max(float(found[0]), 1e-3), float(found[1])
