"""What makes a hand a parallel jaw: two fingertips that one joint moves straight towards each other."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.errors import UnsupportedHand
from dexgrasp.hand import Hand

STRAIGHT = 1e-3
"""Most that a jaw may turn (rad, as a chord), or leave its line, relative to its way, on the whole way."""
STEPS = 5
"""Widths at which that is looked at."""


@dataclass(frozen=True, eq=False)
class Jaws:
    """A parallel jaw in the hand's base frame, float64."""

    joint: int
    """Index of the joint that moves it."""
    closed: float
    """Width between the pads where that joint is 0, m."""
    rate: float
    """Width per unit of the joint."""
    baselines: Float[Tensor, "2 3"]
    """Unit vector from each finger's pad to the other's."""
    approach: Float[Tensor, "3"]
    """The palm's approach direction, made orthogonal to the baselines."""

    @classmethod
    def of(cls, hand: Hand) -> "Jaws":
        """Measure a hand; raises UnsupportedHand for one that is no parallel jaw."""
        lower, upper = hand.limits.double().unbind(-1)
        moving = (upper > lower).nonzero().flatten().tolist()
        if len(hand.fingers) != 2 or len(moving) != 1:
            raise _unsupported(hand, f"one of {len(hand.fingers)} fingers and {len(moving)} moving joints")
        share = torch.linspace(0, 1, STEPS, dtype=torch.float64).unsqueeze(-1)
        tips = hand.fingertips(lower + share * (upper - lower))
        between = tips[:, 1, :3, 3] - tips[:, 0, :3, 3]
        way = tips[:, :, :3, 3] - tips[:1, :, :3, 3]
        span = between[-1] - between[0]
        line = torch.nn.functional.normalize(between[torch.linalg.vector_norm(between, dim=-1).argmax()], dim=0)
        turned = (tips[..., :3, :3] - tips[:1, :, :3, :3]).abs().max()
        aside = (way - (way @ line).unsqueeze(-1) * line).abs().max() / torch.linalg.vector_norm(span).clamp(min=1e-9)
        if float(torch.maximum(turned, aside)) > STRAIGHT or float((span @ line).abs()) < 1e-3:
            raise _unsupported(hand, "one whose fingertips turn, or leave the line between them, as it closes")
        radii = sum(finger.tip_radius for finger in hand.fingers)
        widths, joint = between @ line - radii, moving[0]
        rate = float((widths[-1] - widths[0]) / (upper[joint] - lower[joint]))
        palm = hand.base_T_palm[:3, 2].double()
        approach = palm - (palm @ line) * line
        if float(torch.linalg.vector_norm(approach)) < STRAIGHT:
            raise _unsupported(hand, "one whose jaws move along its palm's approach")
        approach = approach / torch.linalg.vector_norm(approach)
        return cls(joint, float(widths[0] - rate * lower[joint]), rate, torch.stack([line, -line]), approach)

    def frames(self, finger: Int[Tensor, "N"], like: Tensor) -> Float[Tensor, "N 3 3"]:
        """Return base_R_jaw seen from fingers: columns baseline b, approach a, b x a."""
        b, a = self.baselines.to(like)[finger], self.approach.to(like).expand(len(finger), 3)
        return torch.stack([b, a, torch.linalg.cross(b, a)], dim=-1)


def _unsupported(hand: Hand, found: str) -> UnsupportedHand:
    return UnsupportedHand(
        "a parallel jaw for repr=contact_width: two fingers that one joint moves straight towards each other",
        f"{hand.name}, {found}",
        "take repr=contact, contact_roll, grasp_type or pose, or hand=panda",
    )
