"""Heads that tell a grasp from one fingertip contact in three stages: finger, direction and main joints, the rest."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp.errors import DexgraspError
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
    shared_joints,
    told_grasps,
)
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.touching import fingers_as_prediction, fingers_loss, told_fingers, told_size

OWN, SHARED, SUPPORTING = range(3)
"""What a joint slot of a finger is."""
FEWEST = 16
"""Fewer contact points than this in a micro-batch: the heads behind the first run at all points."""


class StagedContact(Representation):
    """Parameters: `lead` numbers of the direction, then joint angles in slots: the touching finger's main joints first.

    Of a hand that grasps with some of its fingers, too, which of them touch follows: 1 or 0 each. The joints of a
    finger that does not touch are told like all others: it stays as they say, open and out of the way.

    What a slot means depends on the finger (paper: theta_ms, theta_m, theta_s1, theta_s2); each keeps the hand's
    order. Three stages (paper, figure 3): which finger touches, if any; direction and main joints; supporting
    joints. Angles in rad. In training, stages 2 and 3 run at contact points only.

    A subclass says what it tells of the direction u from the fingertip to the outer joint, and of all else that places
    the distal link: `lead`, `told` and the abstract methods. The contact frame is `contact_frame(normals)`.

    Args:
        hand: any hand.
        channels: size of a point feature.
        per_finger: tell projection and joints for each finger, so that the one that touches picks its own; else once,
            as in the paper.
        refine: predict supporting joints from features and the outputs of stages 1 and 2; else from features alone.
        anchors: the direction is told as the likeliest of so many (`spread`), and numbers relative to it. Where several
            grasps fit a point, one of them is told and not their mean.
        conditioned: each head also sees what was decided before it, as one-hot classes: finger, anchor, bins of shared
            joints, bins of the finger's own joints. In training these are the true ones. All numbers then belong to
            one grasp.
        hidden: widths of the hidden layers of each MLP, one per head.
        bins, shared_bins, joint_bins: see `JointBins`.
        alpha, beta, gamma, delta: weights of finger identity, finger projection, joints, and which fingers touch.
        gamma_m, gamma_ms, gamma_s: weights of the finger's own main joints, of main joints that all fingers share
            (spread), and of supporting joints.
        none_weight, focal: see `finger_loss`.
        huber: residual (in bins) at which the residual's loss turns from quadratic to linear.
    """

    label_options: tuple[str, ...] = ()
    """Options on which the numbers in `Targets` depend: none, bins are made of angles by the loss."""
    lead: int
    """Number of parameters before the joints."""
    told: int
    """How many numbers are told of each anchor, beside its logit."""

    def __init__(
        self,
        hand: Hand,
        channels: int,
        *,
        per_finger: bool = False,
        refine: bool = True,
        anchors: int = 48,
        conditioned: bool = True,
        hidden: Sequence[int] = (128,),
        bins: int = 7,
        shared_bins: int = 12,
        joint_bins: Mapping[str, int] | None = None,
        alpha: float = 1.0,
        beta: float = 5.0,
        gamma: float = 5.0,
        delta: float = 1.0,
        gamma_m: float = 1.0,
        gamma_ms: float = 1.0,
        gamma_s: float = 1.0,
        none_weight: float = 1.0,
        focal: float = 0.0,
        huber: float = 1.0,
    ) -> None:
        super().__init__()
        self.hand, self.refine = hand, refine
        self.alpha, self.beta, self.gamma, self.delta = alpha, beta, gamma, delta
        self.gammas = {"main": gamma_m, "shared": gamma_ms, "supporting": gamma_s}
        self.none_weight, self.focal, self.huber = none_weight, focal, huber
        self.joints = JointBins(hand, bins=bins, shared=shared_bins, by_joint=joint_bins)
        order = torch.tensor([hand.joint_index(f.main + f.supporting) for f in hand.fingers])
        self.fingers = told_size(hand)
        self.size = self.lead + order.shape[1] + self.fingers

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

        if anchors < 1:
            raise DexgraspError("repr.anchors of at least 1", str(anchors), "1 tells the direction outright")
        self.register_buffer("anchors", self.spread(anchors), persistent=False)
        self.anchors: Tensor
        self.choices = anchors

        self.versions, self.conditioned = len(hand.fingers) if per_finger else 1, conditioned
        fingers, each = len(hand.fingers), 2 * self.joints.most * self.versions
        self.slots = {"shared": self.first_slots, "own": self.second_slots, "supporting": self.supporting_slots}
        sizes = {"finger": fingers + 1, "projection": (1 + self.told) * anchors * self.versions}
        sizes |= {"touching": self.fingers * self.versions} if self.fingers else {}
        sizes |= {name: each * len(slots) for name, slots in self.slots.items()}
        # What each head sees of those before it, beside the features.
        decided = {"finger": fingers, "projection": anchors} | ({"touching": fingers} if self.fingers else {})
        decided |= {name: self.joints.most * len(slots) for name, slots in self.slots.items()}
        known = [sum(list(decided.values())[:number]) if conditioned else 0 for number in range(len(sizes))]
        known[-1] = known[-1] + sum(list(sizes.values())[:-1]) if refine else 0
        self.stages = nn.ModuleDict(
            {
                name: Heads(channels + extra, {name: size}, hidden, separate=True)
                for (name, size), extra in zip(sizes.items(), known, strict=True)
            }
        )

    @staticmethod
    @abstractmethod
    def spread(count: int) -> Float[Tensor, "A 3"]:
        """Return `count` unit vectors, float64, spread evenly over the directions that can be told."""

    @abstractmethod
    def direction(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        """Return the unit vector u in the contact frame."""

    @abstractmethod
    def measure(
        self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps
    ) -> tuple[Float[Tensor, "N L"], Bool[Tensor, "N"]]:
        """Return the `lead` parameters of grasps, all with a finger, and which can be told."""

    @abstractmethod
    def relative(self, parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]) -> Float[Tensor, "N T"]:
        """Return the `told` numbers that an anchor says of these parameters."""

    @abstractmethod
    def miss(
        self, told: Float[Tensor, "N T"], parameters: Float[Tensor, "N P"], anchor: Int[Tensor, "N"]
    ) -> Float[Tensor, "N"]:
        """Return how far an anchor's numbers are from the truth; 0 for `relative`."""

    @abstractmethod
    def base(
        self,
        points: Float[Tensor, "N 3"],
        normals: Float[Tensor, "N 3"],
        finger: Int[Tensor, "N"],
        told: Float[Tensor, "N T"],
        anchor: Int[Tensor, "N"],
        joints: Float[Tensor, "N J"],
    ) -> Float[Tensor, "N 4 4"]:
        """Return frame_T_base (m) of hands that touch the points with these fingers."""

    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps; `encodable` is False where no finger was chosen (then `finger` is 0), or by `measure`.

        And where a finger does not touch of a hand that grasps with all of them (`Hand.least_fingers`).
        """
        grasps = grasps.to(points)
        finger = grasps.finger.clamp(min=0)
        lead, encodable = self.measure(points, normals, grasps.replace(finger=finger))
        slots = grasps.joints.gather(-1, self.order[finger])
        if not self.fingers:
            encodable = encodable & grasps.touching.all(dim=-1)
        return Targets(
            finger=grasps.finger + 1,
            parameters=torch.cat([lead, slots, grasps.touching[:, : self.fingers].to(lead)], dim=-1),
            quality=grasps.quality,
            encodable=encodable & (grasps.finger >= 0),
        )

    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point."""
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
        anchor = outputs["projection"][..., 0].argmax(-1)
        base = self.base(points, normals, finger, _told(outputs["projection"], anchor), anchor, joints)
        touching = told_fingers(self.hand, outputs.get("touching"), finger)
        return told_grasps(self.hand, points, normals, finger, base, joints, 1 - probability[:, 0], touching)

    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Run the three stages; `choice` takes another than the likeliest anchor, the less likely the higher it is.

        Returns finger (N, F + 1) logits, projection (N, V, anchors, 1 + told): logits and numbers, main and
        supporting (N, V, slots, 2, bins): logits and residuals, touching (N, V, F) logits where fingers
        may be left out. V is F with `per_finger`, else 1.
        """
        outputs = self.stages["finger"](features)
        if truth is None:
            return outputs | self._tell(features, outputs["finger"], None, (choice,))
        rows = contact_points(truth)
        if len(rows) < FEWEST:  # too few for batch statistics
            return outputs | self._tell(features, outputs["finger"], truth)
        told = self._tell(features.index_select(0, rows), outputs["finger"].index_select(0, rows), truth[rows])
        return outputs | {
            name: value.new_zeros(len(features), *value.shape[1:]).index_copy_(0, rows, value)
            for name, value in told.items()
        }

    def answers(self, features: Float[Tensor, "N C"], count: int) -> Prediction:
        """Return the first `count` choices; what does not depend on the anchor is found once."""
        outputs = self.stages["finger"](features)
        told = self._tell(features, outputs["finger"], None, range(count))
        return {"finger": outputs["finger"].repeat(count, 1)} | told

    def graspable(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N"]:
        """Return the logit of the score, from the first head alone."""
        return any_finger(self.stages["finger"](features)["finger"])

    def _tell(
        self,
        features: Float[Tensor, "N C"],
        classes: Float[Tensor, "N K"],
        truth: Targets | None,
        choices: Sequence[int] = (0,),
    ) -> Prediction:
        """Run stages 2 and 3, head by head, each knowing what was decided before it; (choices * N, ...)."""
        finger = classes[:, 1:].argmax(-1)
        if truth is not None:
            finger = torch.where(truth.finger > 0, truth.finger - 1, finger)
        known = [F.one_hot(finger, len(self.hand.fingers)).to(features)]
        raw = {"finger": classes}
        shaped: Prediction = {}
        for name in list(self.stages)[1:]:
            seen = [features, *(known if self.conditioned else [])]
            if name == "supporting":
                seen = [*seen, *raw.values()] if self.refine else [features]
            raw |= self.stages[name](*seen)
            shapes = {"projection": (len(self.anchors), 1 + self.told), "touching": (self.fingers,)}
            shape = shapes[name] if name in shapes else (len(self.slots[name]), 2, self.joints.most)
            shaped[name] = raw[name].unflatten(-1, (self.versions, *shape))
            if name == "projection":  # what is known by now is the same for all choices, and stays as it is
                every = [_without_likeliest(shaped[name], choice) if choice else shaped[name] for choice in choices]
                shaped[name] = torch.cat(every)
                finger = finger.repeat(len(every)) if len(every) > 1 else finger
            elif len(choices) > 1 and len(shaped[name]) < len(finger):  # a head that sees nothing of the choice
                shaped[name] = shaped[name].repeat(len(choices), *[1] * (shaped[name].dim() - 1))
            if self.conditioned and name != "supporting":
                known.append(self._decided(name, shaped[name], finger, truth))
        position = [(self.first_slots + self.second_slots).index(slot) for slot in self.main_slots]
        return {
            **{name: shaped[name] for name in ("projection", "touching") if name in shaped},
            "main": torch.cat([shaped["shared"], shaped["own"]], dim=2)[:, :, position],
            "supporting": shaped["supporting"],
        }

    def _decided(
        self, name: str, outputs: Tensor, finger: Int[Tensor, "N"], truth: Targets | None
    ) -> Float[Tensor, "N D"]:
        """Return one-hot which anchor, or which bins, were decided: the true ones where known, else the likeliest."""
        own = of_finger({"": outputs.detach()}, finger)[""]
        if name == "projection":
            chosen = own[..., 0].argmax(-1)
            true = chosen if truth is None else self._anchor(truth.parameters)
            chosen = chosen if truth is None else torch.where(truth.finger > 0, true, chosen)
            return F.one_hot(chosen, len(self.anchors)).to(outputs)
        if name == "touching":
            told = told_fingers(self.hand, own, finger)
            true = told if truth is None else truth.parameters[:, -self.fingers :] > 0.5
            known = (finger < 0) if truth is None else truth.finger > 0
            return torch.where(known.unsqueeze(-1), true, told).to(outputs)
        slots = self.slots[name]
        if not slots:
            return own.new_zeros(len(own), 0)
        joint = self.order[finger][:, slots]
        chosen = self.joints.likeliest(own[..., 0, :], joint)
        if truth is not None:
            true, _ = self.joints.split(truth.parameters[:, self.lead :][:, slots], joint)
            chosen = torch.where((truth.finger > 0).unsqueeze(-1), true, chosen)
        return F.one_hot(chosen, self.joints.most).to(outputs).flatten(1)

    def _anchor(self, parameters: Float[Tensor, "N P"]) -> Int[Tensor, "N"]:
        """Return the anchor nearest to each direction."""
        return (self.direction(parameters) @ self.anchors.to(parameters).T).argmax(-1)

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return METHOD section 2's terms: finger, projection, main, shared, supporting; and touching, where told.

        The projection's is `miss` at the true anchor, and cross-entropy on the anchor where there are several.
        Points that are graspable but not encodable count nowhere; all terms but the first count contact points only.
        """
        known, contact = known_points(targets), contact_points(targets)
        classes = finger_loss(
            prediction["finger"].index_select(0, known),
            targets.finger[known],
            none_weight=self.none_weight,
            focal=self.focal,
        )
        truth, finger = targets.parameters[contact], targets.finger[contact] - 1
        told = self.main_slots + self.supporting_slots
        joint, kind = self.order[finger][:, told], self.kind[finger][:, told]
        outputs = of_finger({name: value.index_select(0, contact) for name, value in prediction.items()}, finger)
        logits, residuals = self._joint_outputs(outputs)
        joints = self.joints.loss(logits, residuals, truth[:, self.lead :][:, told], joint, huber=self.huber)
        anchor = self._anchor(truth)
        projection = self.miss(_told(outputs["projection"], anchor).to(truth), truth, anchor)
        projection = projection + F.cross_entropy(outputs["projection"][..., 0], anchor, reduction="none")
        terms = {"finger": self.alpha * classes, "projection": self.beta * mean(projection)}
        for index, (name, weight) in enumerate(self.gammas.items()):
            terms[name] = self.gamma * weight * mean(joints * (kind == index))
        if self.fingers:
            touching = fingers_loss(outputs["touching"], truth[:, -self.fingers :], finger)
            terms["touching"] = self.delta * mean(touching)
        return terms

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out."""
        finger = (targets.finger - 1).clamp(min=0)
        classes = CERTAIN * F.one_hot(targets.finger, len(self.hand.fingers) + 1).to(targets.parameters)
        anchor = self._anchor(targets.parameters)
        logits = CERTAIN * F.one_hot(anchor, len(self.anchors)).to(targets.parameters)
        told = self.relative(targets.parameters, anchor).unsqueeze(1).expand(-1, len(self.anchors), -1)
        outputs = {"projection": torch.cat([logits.unsqueeze(-1), told], dim=-1)}
        for name, slots in (("main", self.main_slots), ("supporting", self.supporting_slots)):
            angles = targets.parameters[:, self.lead :][:, slots]
            outputs[name] = torch.stack(self.joints.as_prediction(angles, self.order[finger][:, slots]), dim=-2)
        if self.fingers:
            outputs["touching"] = fingers_as_prediction(targets.parameters[:, -self.fingers :])
        return {"finger": classes} | every_finger(outputs, self.versions)

    def _joint_outputs(self, outputs: Prediction) -> tuple[Tensor, Tensor]:
        logits, residuals = torch.cat([outputs["main"], outputs["supporting"]], dim=1).unbind(-2)
        return logits, residuals


def _told(projection: Float[Tensor, "N A K"], anchor: Int[Tensor, "N"]) -> Float[Tensor, "N T"]:
    """Return what the chosen anchors say, without their logits."""
    return projection[torch.arange(len(anchor), device=anchor.device), anchor, 1:]


def _without_likeliest(projection: Float[Tensor, "N V A K"], count: int) -> Float[Tensor, "N V A K"]:
    """Rule out the `count` likeliest anchors."""
    logits, told = projection[..., :1], projection[..., 1:]
    best = logits.topk(count, dim=2).indices
    return torch.cat([logits.scatter(2, best, torch.finfo(logits.dtype).min), told], dim=-1)


def _kinds(hand: Hand) -> Int[Tensor, "F J"]:
    """Return what each slot of each finger is: its own main joint, a main joint of all fingers, or supporting."""
    shared = shared_joints(hand)
    rows = [[SHARED if n in shared else OWN for n in f.main] + [SUPPORTING] * len(f.supporting) for f in hand.fingers]
    return torch.tensor(rows)
