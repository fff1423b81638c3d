"""A grasp told from one fingertip contact: finger projection, main joints, supporting joints."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.contact_frame import place, project
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import (
    CERTAIN,
    Heads,
    JointBins,
    contact_points,
    every_finger,
    finger_loss,
    known_points,
    mean,
    of_finger,
    shared_joints,
    told_grasps,
)
from dexgrasp.representation import Prediction, Representation, Targets

OWN, SHARED, SUPPORTING = range(3)
"""What a joint slot of a finger is."""


class Contact(Representation):
    """Parameters: x, y, then joint angles in slots: the touching finger's main joints, then its supporting ones.

    What a slot means depends on the finger (paper: theta_ms, theta_m, theta_s1, theta_s2); each keeps the hand's
    order. Three stages (paper, figure 3): which finger touches, if any; projection and main joints; supporting
    joints. Angles in rad.

    The representation is lossy: it assumes that the contact normal lies in the finger's flexion plane.

    Args:
        hand: any hand.
        channels: size of a point feature.
        per_finger: tell projection and joints for each finger, so that the one that touches picks its own; else once,
            as in the paper.
        refine: predict supporting joints from features and the outputs of stages 1 and 2; else from features alone.
        conditioned: each stage also sees what was decided before it, as one-hot classes: stage 2 the finger and the
            bins of shared joints (which it tells first), stage 3 all bins of main joints. In training these are the
            true ones. Where several grasps fit a point, the numbers then belong to one of them, not to their mean.
        hidden: widths of the hidden layers of each MLP.
        separate_heads: an MLP for each output, as in the paper; else the outputs of a stage share hidden layers.
        bins, shared_bins, joint_bins: see `JointBins`.
        alpha, beta, gamma: weights of finger identity, finger projection and joints.
        gamma_m, gamma_ms, gamma_s: weights of the finger's own main joints, of main joints that all fingers share
            (spread), and of supporting joints.
        none_weight, focal: see `finger_loss`.
        huber: residual (in bins) at which the residual's loss turns from quadratic to linear.
    """

    label_options: tuple[str, ...] = ()
    """Options on which the numbers in `Targets` depend: none, bins are made of angles by the loss."""

    def __init__(
        self,
        hand: Hand,
        channels: int,
        *,
        per_finger: bool = False,
        refine: bool = True,
        conditioned: bool = True,
        hidden: Sequence[int] = (128,),
        separate_heads: bool = False,
        bins: int = 7,
        shared_bins: int = 12,
        joint_bins: Mapping[str, int] | None = None,
        alpha: float = 1.0,
        beta: float = 5.0,
        gamma: float = 5.0,
        gamma_m: float = 1.0,
        gamma_ms: float = 1.0,
        gamma_s: float = 1.0,
        none_weight: float = 1.0,
        focal: float = 0.0,
        huber: float = 1.0,
    ) -> None:
        super().__init__()
        self.hand, self.refine = hand, refine
        self.alpha, self.beta, self.gamma = alpha, beta, gamma
        self.gammas = {"main": gamma_m, "shared": gamma_ms, "supporting": gamma_s}
        self.none_weight, self.focal, self.huber = none_weight, focal, huber
        self.joints = JointBins(hand, bins=bins, shared=shared_bins, by_joint=joint_bins)
        order = torch.tensor([hand.joint_index(f.main + f.supporting) for f in hand.fingers])
        self.size = 2 + order.shape[1]

        # A joint slot is told in stage 2 if it is a main joint of any finger; slots that never move have no head.
        told = (self.joints.count[order] > 0).any(dim=0)
        mains = max(len(f.main) for f in hand.fingers)
        kinds = _kinds(hand)
        self.main_slots = [k for k in range(mains) if told[k]]
        self.first_slots = [k for k in self.main_slots if conditioned and bool((kinds[:, k] == SHARED).all())]
        self.second_slots = [k for k in self.main_slots if k not in self.first_slots]
        self.supporting_slots = [k for k in range(mains, order.shape[1]) if told[k]]
        self.register_buffer("order", order, persistent=False)
        self.register_buffer("kind", kinds, persistent=False)
        self.order: Tensor
        self.kind: Tensor

        self.versions, self.conditioned = len(hand.fingers) if per_finger else 1, conditioned
        each = 2 * self.joints.most * self.versions
        known = len(hand.fingers) if conditioned else 0
        first = {"finger": len(hand.fingers) + 1}
        shared = {"first": each * len(self.first_slots)}
        second = {"xy": 2 * self.versions, "second": each * len(self.second_slots)}
        third = {"supporting": each * len(self.supporting_slots)}
        self.stage_1 = Heads(channels, first, hidden, separate=separate_heads)
        self.stage_2_shared = Heads(channels + known, shared, hidden, separate=separate_heads)
        known += self.joints.most * len(self.first_slots)
        self.stage_2 = Heads(channels + known, second, hidden, separate=separate_heads)
        if refine:
            known += self.joints.most * len(self.second_slots) if conditioned else 0
            known += sum((first | shared | second).values())
        self.stage_3 = Heads(channels + (known if refine else 0), third, hidden, separate=separate_heads)

    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps; `encodable` is False where z <= 0, or where no finger was chosen (then `finger` is 0).

        Lossy where the normal leaves the flexion plane: decode to see what is left of the grasp.
        """
        grasps = grasps.to(points)
        finger = grasps.finger.clamp(min=0)
        xy, encodable = project(self.hand, finger, points, normals, grasps.pose, grasps.joints)
        slots = grasps.joints.gather(-1, self.order[finger])
        return Targets(
            finger=grasps.finger + 1,
            parameters=torch.cat([xy, slots], dim=-1),
            quality=grasps.quality,
            encodable=encodable & (grasps.finger >= 0),
        )

    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point; (x, y) outside the unit disc is projected onto it."""
        prediction = {name: value.to(points) for name, value in prediction.items()}
        probability = prediction["finger"].softmax(-1)
        finger = prediction["finger"][:, 1:].argmax(-1)
        joint = self.order[finger]
        slots = self.joints.lower[joint].to(points)
        told = self.main_slots + self.supporting_slots
        outputs = of_finger(prediction, finger)
        logits, residuals = self._joint_outputs(outputs)
        slots[:, told] = self.joints.join(logits, residuals, joint[:, told])
        joints = torch.empty_like(slots).scatter(-1, joint, slots)
        base = place(self.hand, finger, points, normals, outputs["xy"], joints)
        return told_grasps(self.hand, points, normals, finger, base, joints, 1 - probability[:, 0])

    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None) -> Prediction:
        """Run the three stages: finger (N, F + 1) logits, xy (N, V, 2), main and supporting (N, V, slots, 2, bins).

        V is F with `per_finger`, else 1; bins are logits, then residuals.
        """
        told = self.stage_1(features)
        finger = told["finger"][:, 1:].argmax(-1)
        if truth is not None:
            finger = torch.where(truth.finger > 0, truth.finger - 1, finger)
        known = [F.one_hot(finger, len(self.hand.fingers)).to(features)] if self.conditioned else []
        told |= self.stage_2_shared(torch.cat([features, *known], dim=-1))
        first = self._unflat(told["first"], len(self.first_slots))
        if self.conditioned:
            known += self._decided(first, finger, self.first_slots, truth)
        told |= self.stage_2(torch.cat([features, *known], dim=-1))
        second = self._unflat(told["second"], len(self.second_slots))
        if self.conditioned and self.refine:
            known += self._decided(second, finger, self.second_slots, truth)
        before = torch.cat([features, *known, *told.values()], dim=-1) if self.refine else features
        told |= self.stage_3(before)
        position = [(self.first_slots + self.second_slots).index(slot) for slot in self.main_slots]
        return {
            "finger": told["finger"],
            "xy": told["xy"].unflatten(-1, (self.versions, 2)),
            "main": torch.cat([first, second], dim=2)[:, :, position],
            "supporting": self._unflat(told["supporting"], len(self.supporting_slots)),
        }

    def _unflat(self, outputs: Tensor, slots: int) -> Tensor:
        return outputs.unflatten(-1, (self.versions, slots, 2, self.joints.most))

    def _decided(
        self, outputs: Tensor, finger: Int[Tensor, "N"], slots: list[int], truth: Targets | None
    ) -> list[Float[Tensor, "N D"]]:
        """Return the one-hot bins of some slots: the true ones where they are known, else the likeliest."""
        if not slots:
            return []
        joint = self.order[finger][:, slots]
        logits = of_finger({"": outputs}, finger)[""][..., 0, :]
        chosen = self.joints.likeliest(logits, joint)
        if truth is not None:
            true, _ = self.joints.split(truth.parameters[:, 2:][:, slots], joint)
            chosen = torch.where((truth.finger > 0).unsqueeze(-1), true, chosen)
        return [F.one_hot(chosen, self.joints.most).to(outputs).flatten(1)]

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return METHOD section 2's terms: finger, projection, main, shared, supporting.

        Points that are graspable but not encodable count nowhere; all terms but the first count contact points only.
        """
        known, contact = known_points(targets), contact_points(targets)
        classes = finger_loss(
            prediction["finger"][known], targets.finger[known], none_weight=self.none_weight, focal=self.focal
        )
        truth, finger = targets.parameters[contact], targets.finger[contact] - 1
        told = self.main_slots + self.supporting_slots
        joint, kind = self.order[finger][:, told], self.kind[finger][:, told]
        outputs = of_finger({name: value[contact] for name, value in prediction.items()}, finger)
        logits, residuals = self._joint_outputs(outputs)
        joints = self.joints.loss(logits, residuals, truth[:, 2:][:, told], joint, huber=self.huber)
        projection = torch.linalg.vector_norm(outputs["xy"].to(truth) - truth[:, :2], dim=-1)
        terms = {"finger": self.alpha * classes, "projection": self.beta * mean(projection)}
        for index, (name, weight) in enumerate(self.gammas.items()):
            terms[name] = self.gamma * weight * mean(joints * (kind == index))
        return terms

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out."""
        finger = (targets.finger - 1).clamp(min=0)
        classes = CERTAIN * F.one_hot(targets.finger, len(self.hand.fingers) + 1).to(targets.parameters)
        outputs = {"xy": targets.parameters[:, :2]}
        for name, slots in (("main", self.main_slots), ("supporting", self.supporting_slots)):
            told = self.joints.as_prediction(targets.parameters[:, 2:][:, slots], self.order[finger][:, slots])
            outputs[name] = torch.stack(told, dim=-2)
        return {"finger": classes} | every_finger(outputs, self.versions)

    def _joint_outputs(self, outputs: Prediction) -> tuple[Tensor, Tensor]:
        logits, residuals = torch.cat([outputs["main"], outputs["supporting"]], dim=1).unbind(-2)
        return logits, residuals


def _kinds(hand: Hand) -> Int[Tensor, "F J"]:
    """Return what each slot of each finger is: its own main joint, a main joint of all fingers, or supporting."""
    shared = shared_joints(hand)
    rows = [[SHARED if n in shared else OWN for n in f.main] + [SUPPORTING] * len(f.supporting) for f in hand.fingers]
    return torch.tensor(rows)
