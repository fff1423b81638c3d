"""A grasp told outright: where the base is, how it is turned, and every joint."""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dexgrasp import geometry
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import (
    CERTAIN,
    Heads,
    JointBins,
    any_finger,
    contact_points,
    every_finger,
    finger_loss,
    known_points,
    mean,
    of_finger,
    told_grasps,
)
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.touching import fingers_as_prediction, fingers_loss, told_fingers, told_size


class Pose(Representation):
    """Parameters: offset from the point to the base (3, in units of `scale`), rotation (6), joints in the hand's order.

    Of a hand that grasps with some of its fingers, too, which of them touch follows: 1 or 0 each. The joints of a
    finger that does not touch are told like all others.

    The rotation is told by the first two columns of frame_R_base (Zhou et al. 2019, "On the continuity of rotation
    representations"), made orthonormal by Gram-Schmidt. Lossless: every grasp can be told from every point. The
    normal is not used.

    Args:
        hand: any hand.
        channels: size of a point feature.
        per_finger: tell all but the finger for each finger, so that the one that touches picks its own; else once.
        scale: unit of the offset, m; about the size of a hand makes outputs of order one.
        hidden: widths of the hidden layers of each MLP.
        separate_heads: an MLP for each output; else all but the finger's share hidden layers.
        bins, shared_bins, joint_bins: see `JointBins`.
        alpha, beta_offset, beta_rotation, gamma, delta: weights of finger identity, offset, rotation, joints, and which
            fingers touch.
        none_weight, focal: see `finger_loss`.
        huber: residual (in bins) at which the residual's loss turns from quadratic to linear.
    """

    label_options: tuple[str, ...] = ("scale",)
    """Options on which the numbers in `Targets` depend."""

    def __init__(
        self,
        hand: Hand,
        channels: int,
        *,
        per_finger: bool = False,
        scale: float = 0.1,
        hidden: Sequence[int] = (128,),
        separate_heads: bool = False,
        bins: int = 7,
        shared_bins: int = 12,
        joint_bins: Mapping[str, int] | None = None,
        alpha: float = 1.0,
        beta_offset: float = 5.0,
        beta_rotation: float = 5.0,
        gamma: float = 5.0,
        delta: float = 1.0,
        none_weight: float = 1.0,
        focal: float = 0.0,
        huber: float = 1.0,
    ) -> None:
        super().__init__()
        self.hand, self.scale = hand, scale
        self.alpha, self.beta_offset, self.beta_rotation, self.gamma = alpha, beta_offset, beta_rotation, gamma
        self.delta = delta
        self.none_weight, self.focal, self.huber = none_weight, focal, huber
        self.joints = JointBins(hand, bins=bins, shared=shared_bins, by_joint=joint_bins)
        self.told = torch.nonzero(self.joints.count).flatten().tolist()
        self.fingers = told_size(hand)
        self.size = 9 + len(hand.joint_names) + self.fingers
        self.versions = len(hand.fingers) if per_finger else 1
        self.shapes = {"offset": (3,), "rotation": (6,), "joints": (len(self.told), 2, self.joints.most)}
        self.shapes |= {"touching": (self.fingers,)} if self.fingers else {}
        sizes = {name: self.versions * math.prod(shape) for name, shape in self.shapes.items()}
        self.stage_1 = Heads(channels, {"finger": len(hand.fingers) + 1}, hidden, separate=separate_heads)
        self.stage_2 = Heads(channels, sizes, hidden, separate=separate_heads)

    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps; `encodable` is False only where no finger was chosen (then `finger` is 0).

        And where a finger does not touch of a hand that grasps with all of them (`Hand.least_fingers`).
        """
        grasps = grasps.to(points)
        offset = (grasps.pose[:, :3, 3] - points) / self.scale
        columns = grasps.pose[:, :3, :2].transpose(-1, -2).flatten(1)
        touching = grasps.touching[:, : self.fingers].to(offset)
        return Targets(
            finger=grasps.finger + 1,
            parameters=torch.cat([offset, columns, grasps.joints, touching], dim=-1),
            quality=grasps.quality,
            encodable=(grasps.finger >= 0) & (grasps.touching.all(dim=-1) | bool(self.fingers)),
        )

    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point."""
        prediction = {name: value.to(points) for name, value in prediction.items()}
        probability = prediction["finger"].softmax(-1)
        finger = prediction["finger"][:, 1:].argmax(-1)
        joint = torch.tensor(self.told, device=points.device).expand(len(points), -1)
        joints = self.joints.lower.to(points).repeat(len(points), 1)
        outputs = of_finger(prediction, finger)
        logits, residuals = outputs["joints"].unbind(-2)
        joints[:, self.told] = self.joints.join(logits, residuals, joint)
        rotation = geometry.orthonormal(outputs["rotation"])
        base = geometry.pose(rotation, points + self.scale * outputs["offset"])
        touching = told_fingers(self.hand, outputs.get("touching"), finger)
        return told_grasps(self.hand, points, normals, finger, base, joints, 1 - probability[:, 0], touching)

    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Return finger (N, F + 1) logits, offset (N, V, 3), rotation (N, V, 6), joints (N, V, slots, 2, bins).

        V is F with `per_finger`, else 1; bins are logits, then residuals. Where told, touching (N, V, F) logits. No
        head builds on another's answer.
        """
        told = self.stage_2(features)
        shaped = {name: told[name].unflatten(-1, (self.versions, *shape)) for name, shape in self.shapes.items()}
        return self.stage_1(features) | shaped

    def graspable(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N"]:
        """Return the logit of the score, from the first head alone."""
        return any_finger(self.stage_1(features)["finger"])

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return the terms finger, offset, rotation, joints and, where told, touching.

        All but the first count contact points only.
        """
        known, contact = known_points(targets), contact_points(targets)
        classes = finger_loss(
            prediction["finger"][known], targets.finger[known], none_weight=self.none_weight, focal=self.focal
        )
        truth = targets.parameters[contact]
        joint = torch.tensor(self.told, device=truth.device).expand(len(truth), -1)
        rows = {name: value[contact] for name, value in prediction.items()}
        finger = targets.finger[contact] - 1
        outputs = of_finger(rows, finger)
        logits, residuals = outputs["joints"].unbind(-2)
        joints = self.joints.loss(logits, residuals, truth[:, 9:][:, self.told], joint, huber=self.huber)
        offset = torch.linalg.vector_norm(outputs["offset"].to(truth) - truth[:, :3], dim=-1)
        rotation = torch.linalg.vector_norm(outputs["rotation"].to(truth) - truth[:, 3:9], dim=-1)
        terms = {
            "finger": self.alpha * classes,
            "offset": self.beta_offset * mean(offset),
            "rotation": self.beta_rotation * mean(rotation),
            "joints": self.gamma * mean(joints),
        }
        if self.fingers:
            touching = fingers_loss(outputs["touching"], truth[:, -self.fingers :], finger)
            terms["touching"] = self.delta * mean(touching)
        return terms

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out."""
        joint = torch.tensor(self.told, device=targets.finger.device).expand(len(targets), -1)
        angles = targets.parameters[:, 9:][:, self.told]
        outputs = {
            "offset": targets.parameters[:, :3],
            "rotation": targets.parameters[:, 3:9],
            "joints": torch.stack(self.joints.as_prediction(angles, joint), dim=-2),
        }
        if self.fingers:
            outputs["touching"] = fingers_as_prediction(targets.parameters[:, -self.fingers :])
        finger = CERTAIN * F.one_hot(targets.finger, len(self.hand.fingers) + 1).to(targets.parameters)
        return {"finger": finger} | every_finger(outputs, self.versions)
