"""A grasp of parallel jaws told from one contact, after Contact-GraspNet: baseline, approach, width."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp import geometry
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import (
    CERTAIN,
    Heads,
    JointBins,
    contact_points,
    finger_loss,
    known_points,
    mean,
    told_grasps,
)
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp_contact_width.jaws import Jaws


class ContactWidth(Representation):
    """Parameters: baseline b (3), approach a (3), both unit vectors in the scene's frame and orthogonal, width (m).

    b points from the pad that touches here to the other pad, a is the palm's approach direction. The contact is taken
    to be the pad's middle, where the fingertip circle touches it, whatever the normal (Sundermeyer et al. 2021,
    "Contact-GraspNet", equation 1): the base is p + (w / 2) b + d a up to the hand's own constants, which come from its
    kinematics. Lossy by how far from its pad's middle a finger touches.

    Args:
        hand: a parallel jaw; raises UnsupportedHand for any other.
        channels: size of a point feature.
        hidden: widths of the hidden layers of each MLP.
        separate_heads: an MLP for each output; else all but the finger's share hidden layers.
        bins: the width is told as one of so many bins of the jaws' range, and a residual.
        alpha, beta_baseline, beta_approach, gamma: weights of finger identity, baseline, approach and width.
        none_weight, focal: see `finger_loss`.
        huber: residual (in bins) at which the residual's loss turns from quadratic to linear.
    """

    label_options: tuple[str, ...] = ()
    """Options on which the numbers in `Targets` depend: none."""
    size = 7

    def __init__(
        self,
        hand: Hand,
        channels: int,
        *,
        hidden: Sequence[int] = (128,),
        separate_heads: bool = False,
        bins: int = 10,
        alpha: float = 1.0,
        beta_baseline: float = 5.0,
        beta_approach: float = 5.0,
        gamma: float = 5.0,
        none_weight: float = 1.0,
        focal: float = 0.0,
        huber: float = 1.0,
    ) -> None:
        super().__init__()
        self.hand, self.jaws = hand, Jaws.of(hand)
        self.alpha, self.beta_baseline, self.beta_approach, self.gamma = alpha, beta_baseline, beta_approach, gamma
        self.none_weight, self.focal, self.huber = none_weight, focal, huber
        self.joints = JointBins(hand, bins=bins, shared=bins)
        self.shapes = {"directions": (6,), "width": (1, 2, self.joints.most)}
        sizes = {name: math.prod(shape) for name, shape in self.shapes.items()}
        self.stage_1 = Heads(channels, {"finger": len(hand.fingers) + 1}, hidden, separate=separate_heads)
        self.stage_2 = Heads(channels, sizes, hidden, separate=separate_heads)

    def tip_contacts(self, finger: Int[Tensor, "N"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return the pads' middles, whatever the direction."""
        closed = self.hand.limits[:, 0].unsqueeze(0)
        tips = self.hand.fingertips(closed)[0, :, :3, :3]
        radii = self.jaws.baselines.new_tensor([each.tip_radius for each in self.hand.fingers]).unsqueeze(-1)
        middles = radii * (tips.transpose(-1, -2) @ self.jaws.baselines.unsqueeze(-1)).squeeze(-1)
        return middles.to(directions)[finger]

    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps; `encodable` is False where no finger was chosen (then `finger` is 0), or a pad is left out."""
        grasps = grasps.to(points)
        frames = grasps.pose[:, :3, :3] @ self.jaws.frames(grasps.finger.clamp(min=0), points)
        width = self.jaws.closed + self.jaws.rate * grasps.joints[:, self.jaws.joint]
        return Targets(
            finger=grasps.finger + 1,
            parameters=torch.cat([frames[..., 0], frames[..., 1], width.unsqueeze(-1)], dim=-1),
            quality=grasps.quality,
            encodable=(grasps.finger >= 0) & grasps.touching.all(dim=-1),
        )

    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point; the approach is made orthogonal to the baseline."""
        prediction = {name: value.to(points) for name, value in prediction.items()}
        probability = prediction["finger"].softmax(-1)
        finger = prediction["finger"][:, 1:].argmax(-1)
        joints = self.hand.limits[:, 0].to(points).repeat(len(points), 1)
        logits, residuals = prediction["width"].unbind(-2)
        joints[:, self.jaws.joint] = self.joints.join(logits, residuals, self._joint(len(points), points))[:, 0]
        rotation = geometry.orthonormal(prediction["directions"]) @ self.jaws.frames(finger, points).transpose(-1, -2)
        base_T_tip = self.hand.fingertips(joints)[torch.arange(len(finger), device=finger.device), finger]
        pad = geometry.transform(base_T_tip, self.tip_contacts(finger, points))
        base = geometry.pose(rotation, points - (rotation @ pad.unsqueeze(-1)).squeeze(-1))
        return told_grasps(self.hand, points, normals, finger, base, joints, 1 - probability[:, 0])

    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Return finger (N, 3) logits, directions (N, 6) b and a, width (N, 1, 2, bins) logits and residuals."""
        told = self.stage_2(features)
        return self.stage_1(features) | {n: told[n].unflatten(-1, shape) for n, shape in self.shapes.items()}

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return the terms finger, baseline, approach and width; all but the first count contact points only."""
        known, contact = known_points(targets), contact_points(targets)
        classes = finger_loss(
            prediction["finger"][known], targets.finger[known], none_weight=self.none_weight, focal=self.focal
        )
        truth = targets.parameters[contact]
        off = prediction["directions"][contact].to(truth) - truth[:, :6]
        logits, residuals = prediction["width"][contact].unbind(-2)
        joint = self._joint(len(truth), truth)
        width = self.joints.loss(logits, residuals, self._angles(truth), joint, huber=self.huber)
        return {
            "finger": self.alpha * classes,
            "baseline": self.beta_baseline * mean(torch.linalg.vector_norm(off[:, :3], dim=-1)),
            "approach": self.beta_approach * mean(torch.linalg.vector_norm(off[:, 3:], dim=-1)),
            "width": self.gamma * mean(width),
        }

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out."""
        told = self.joints.as_prediction(self._angles(targets.parameters), self._joint(len(targets), targets.finger))
        finger = CERTAIN * F.one_hot(targets.finger, len(self.hand.fingers) + 1).to(targets.parameters)
        return {"finger": finger, "directions": targets.parameters[:, :6], "width": torch.stack(told, dim=-2)}

    def _angles(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 1"]:
        """Return the joint values at these widths."""
        return (parameters[:, 6:] - self.jaws.closed) / self.jaws.rate

    def _joint(self, count: int, like: Tensor) -> Int[Tensor, "N 1"]:
        return torch.full((count, 1), self.jaws.joint, device=like.device)
