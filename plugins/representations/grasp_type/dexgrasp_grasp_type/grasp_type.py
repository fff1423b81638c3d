"""A grasp told as a type, an approach direction, an in-plane angle, a depth and joint offsets, after HGC-Net."""

import math
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp import geometry
from dexgrasp.contact_frame import contact_frame, finger_direction
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import CERTAIN, Heads, contact_points, finger_loss, known_points, mean, told_grasps
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.seeds import stream
from dexgrasp.touching import fingers_as_prediction, fingers_loss, told_fingers, told_size
from dexgrasp_grasp_type.bins import Bins
from dexgrasp_grasp_type.taxonomy import drawn_postures, nearest_type, taxonomy

FEWEST = 8
"""Of the approach directions: fewer leave some that none of them can tell."""


class GraspType(Representation):
    """Parameters: approach direction (3, a unit vector in the scene's frame), in-plane angle (rad), depth (m), joints.

    The approach is the palm's z, the angle turns the palm about it from `contact_frame(approach)`, the depth is how far
    along it the point lies from the palm's origin. Across the approach the hand lies so that the finger that touches
    here does so with its fingertip circle's ball. Joints are told as a type, one of the hand's own, and offsets from
    its posture; all else is told once for each type, so that each has an answer (Li et al. 2022, "HGC-Net").

    Of a hand that grasps with some of its fingers, too, which of them touch follows: 1 or 0 each.

    Types are clusters of the postures of the dataset's grasps, found when a training begins (`prepare`) and kept in the
    checkpoint; before, postures at random. The numbers in `Targets` do not depend on them.

    Args:
        hand: any hand.
        channels: size of a point feature.
        types: number of types.
        approaches: the approach is told as the likeliest of so many directions on the sphere, and an offset in the
            tangent plane.
        angles, depths: the in-plane angle and the depth are told as one of so many bins and a residual.
        scale: unit of the joint offsets, in ranges of the joints.
        hidden: widths of the hidden layers of each MLP.
        separate_heads: an MLP for each output; else all but finger and type share hidden layers.
        alpha, beta_type, beta_approach, beta_angle, beta_depth, gamma, delta: weights of finger identity, type,
            approach, angle, depth, joint offsets, and which fingers touch.
        none_weight, focal: see `finger_loss`.
        huber: residual (in bins; offset in `scale`) at which the loss turns from quadratic to linear.
    """

    label_options: tuple[str, ...] = ()
    """Options on which the numbers in `Targets` depend: none."""

    def __init__(
        self,
        hand: Hand,
        channels: int,
        *,
        types: int = 8,
        approaches: int = 64,
        angles: int = 12,
        depths: int = 8,
        scale: float = 0.1,
        hidden: Sequence[int] = (128,),
        separate_heads: bool = False,
        alpha: float = 1.0,
        beta_type: float = 1.0,
        beta_approach: float = 5.0,
        beta_angle: float = 5.0,
        beta_depth: float = 5.0,
        gamma: float = 5.0,
        delta: float = 1.0,
        none_weight: float = 1.0,
        focal: float = 0.0,
        huber: float = 1.0,
    ) -> None:
        super().__init__()
        least = {"types": (types, 1), "approaches": (approaches, FEWEST), "angles": (angles, 1), "depths": (depths, 1)}
        for name, (value, fewest) in least.items():
            if value < fewest:
                raise DexgraspError(f"repr.{name} of at least {fewest}", str(value), "set it so")
        self.hand, self.choices = hand, types
        self.alpha, self.gamma, self.delta = alpha, gamma, delta
        self.betas = {"type": beta_type, "approach": beta_approach, "angle": beta_angle, "depth": beta_depth}
        self.none_weight, self.focal, self.huber = none_weight, focal, huber
        lower, upper = hand.limits.double().unbind(-1)
        self.moving = (upper > lower).nonzero().flatten().tolist()
        self.fingers = told_size(hand)
        self.size = 5 + len(lower) + self.fingers
        self.angle = Bins(-math.pi, 2 * math.pi / angles, angles, wraps=True)
        near, far = _depths(hand)
        self.depth = Bins(near, (far - near) / depths, depths)
        self.register_buffer("anchors", geometry.golden_spiral(approaches, lowest=-1.0), persistent=False)
        self.register_buffer("ranges", torch.where(upper > lower, upper - lower, 1.0).float(), persistent=False)
        self.register_buffer("centres", drawn_postures(hand, types).float())  # learnt: part of the checkpoint
        self.anchors: Tensor
        self.ranges: Tensor
        self.centres: Tensor
        self.scale = scale
        self.shapes = {"approach": (approaches, 3), "angle": (2, angles), "depth": (2, depths)}
        self.shapes |= {"offsets": (len(self.moving),)} | ({"touching": (self.fingers,)} if self.fingers else {})
        sizes = {name: types * math.prod(shape) for name, shape in self.shapes.items()}
        self.stage_1 = Heads(
            channels, {"finger": len(hand.fingers) + 1, "type": types}, hidden, separate=separate_heads
        )
        self.stage_2 = Heads(channels, sizes, hidden, separate=separate_heads)

    def prepare(self, grasps: Iterable[Grasps]) -> None:
        """Find the hand's types among the grasps of a dataset."""
        self.centres.copy_(taxonomy(self.hand, grasps, len(self.centres)))

    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps; `encodable` is False only where no finger was chosen (then `finger` is 0).

        And where a finger does not touch of a hand that grasps with all of them (`Hand.least_fingers`).
        """
        grasps = grasps.to(points)
        palm = grasps.pose @ self.hand.base_T_palm.to(points)
        approach = palm[:, :3, 2]
        axes = contact_frame(approach).transpose(-1, -2) @ palm[:, :3, :3]
        angle = torch.atan2(axes[:, 1, 0], axes[:, 0, 0]).unsqueeze(-1)
        depth = ((points - palm[:, :3, 3]) * approach).sum(-1, keepdim=True)
        return Targets(
            finger=grasps.finger + 1,
            parameters=torch.cat(
                [approach, angle, depth, grasps.joints, grasps.touching[:, : self.fingers].to(approach)], dim=-1
            ),
            quality=grasps.quality,
            encodable=(grasps.finger >= 0) & (grasps.touching.all(dim=-1) | bool(self.fingers)),
        )

    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point, of its likeliest type."""
        prediction = {name: value.to(points) for name, value in prediction.items()}
        probability = prediction["finger"].softmax(-1)
        finger, kind = prediction["finger"][:, 1:].argmax(-1), prediction["type"].argmax(-1)
        told = _of_type(prediction, kind)
        joints = self.centres.to(points)[kind]
        joints[:, self.moving] += self.scale * (told["offsets"] * self.ranges[self.moving].to(points))
        joints = self.hand.clamp(joints)
        approach = self._approach(told["approach"])
        turn = geometry.axis_angle(approach, self.angle.join(told["angle"]))
        base_T_palm = self.hand.base_T_palm.to(points)
        rotation = turn @ contact_frame(approach) @ base_T_palm[:3, :3].T
        row = torch.arange(len(points), device=points.device)
        tips = self.hand.fingertips(joints)[row, finger]
        frame_R_tip = rotation @ tips[:, :3, :3]
        inward = -(frame_R_tip.transpose(-1, -2) @ normals.unsqueeze(-1)).squeeze(-1)
        touched = geometry.transform(tips, self.tip_contacts(finger, inward))  # by the finger, base frame
        base = points - (rotation @ touched.unsqueeze(-1)).squeeze(-1)
        palm = base + rotation @ base_T_palm[:3, 3]
        depth = ((points - palm) * approach).sum(-1)
        base = base + (depth - self.depth.join(told["depth"])).unsqueeze(-1) * approach
        pose = geometry.pose(rotation, base)
        touching = told_fingers(self.hand, told.get("touching"), finger)
        return told_grasps(self.hand, points, normals, finger, pose, joints, 1 - probability[:, 0], touching)

    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Run the heads; `choice` takes another than the likeliest type, the less likely the higher it is.

        Returns finger (N, F + 1) and type (N, K) logits, and for each type: approach (N, K, approaches, 3) logits and
        offsets, angle (N, K, 2, bins) and depth (N, K, 2, bins) logits and residuals, offsets (N, K, moving joints);
        touching (N, K, F) logits where fingers may be left out.
        """
        first, told = self.stage_1(features), self.stage_2(features)
        if choice:
            best = first["type"].topk(choice, dim=-1).indices
            first["type"] = first["type"].scatter(-1, best, torch.finfo(first["type"].dtype).min)
        return first | {n: told[n].unflatten(-1, (len(self.centres), *shape)) for n, shape in self.shapes.items()}

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return the terms finger, type, approach, angle, depth and joints; all but the first count contact points."""
        known, contact = known_points(targets), contact_points(targets)
        classes = finger_loss(
            prediction["finger"][known], targets.finger[known], none_weight=self.none_weight, focal=self.focal
        )
        truth = targets.parameters[contact]
        kind, anchor, across, offsets = self._parts(truth)
        told = _of_type({name: value[contact] for name, value in prediction.items()}, kind)
        row = torch.arange(len(truth), device=truth.device)
        off = told["approach"][row, anchor, 1:].to(truth) - across
        approach = F.cross_entropy(told["approach"][..., 0], anchor, reduction="none")
        joints = F.smooth_l1_loss(told["offsets"].to(truth), offsets, reduction="none", beta=self.huber)
        terms = {
            "type": F.cross_entropy(prediction["type"][contact], kind, reduction="none"),
            "approach": approach + torch.linalg.vector_norm(off, dim=-1),
            "angle": self.angle.loss(told["angle"], truth[:, 3], self.huber),
            "depth": self.depth.loss(told["depth"], truth[:, 4], self.huber),
        }
        weighed = {name: self.betas[name] * mean(term) for name, term in terms.items()}
        if self.fingers:
            touching = fingers_loss(told["touching"], truth[:, -self.fingers :], targets.finger[contact] - 1)
            weighed["touching"] = self.delta * mean(touching)
        return {"finger": self.alpha * classes, **weighed, "joints": self.gamma * mean(joints)}

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out; every type says the same."""
        truth = targets.parameters
        kind, anchor, across, offsets = self._parts(truth)
        logits = CERTAIN * F.one_hot(anchor, len(self.anchors)).to(truth)
        told = {
            "approach": torch.cat(
                [logits.unsqueeze(-1), across.unsqueeze(1).expand(-1, len(self.anchors), -1)], dim=-1
            ),
            "angle": self.angle.as_prediction(truth[:, 3]),
            "depth": self.depth.as_prediction(truth[:, 4]),
            "offsets": offsets,
        }
        if self.fingers:
            told["touching"] = fingers_as_prediction(truth[:, -self.fingers :])
        types = len(self.centres)
        finger = CERTAIN * F.one_hot(targets.finger, len(self.hand.fingers) + 1).to(truth)
        each = {name: value.unsqueeze(1).expand(-1, types, *value.shape[1:]).clone() for name, value in told.items()}
        return {"finger": finger, "type": CERTAIN * F.one_hot(kind, types).to(truth), **each}

    def _parts(
        self, truth: Float[Tensor, "N P"]
    ) -> tuple[Int[Tensor, "N"], Int[Tensor, "N"], Float[Tensor, "N 2"], Float[Tensor, "N S"]]:
        """Return type, approach's anchor and offset in its tangent plane, and joint offsets in units of `scale`."""
        joints, ranges = truth[:, 5 : 5 + len(self.ranges)], self.ranges.to(truth)
        kind = nearest_type(joints, self.centres.to(truth), ranges)
        anchors = self.anchors.to(truth)
        anchor = (truth[:, :3] @ anchors.T).argmax(-1)
        frame = contact_frame(anchors)[anchor]
        across = (frame.transpose(-1, -2) @ truth[:, :3].unsqueeze(-1)).squeeze(-1)[:, :2]
        offsets = (joints - self.centres.to(truth)[kind]) / ranges / self.scale
        return kind, anchor, across, offsets[:, self.moving]

    def _approach(self, told: Float[Tensor, "N A 3"]) -> Float[Tensor, "N 3"]:
        anchor = told[..., 0].argmax(-1)
        across = told[torch.arange(len(anchor), device=anchor.device), anchor, 1:]
        return finger_direction(across, contact_frame(self.anchors.to(told))[anchor])


def _of_type(prediction: Prediction, kind: Int[Tensor, "N"]) -> Prediction:
    """Return what is told of one type at each point."""
    row = torch.arange(len(kind), device=kind.device)
    return {name: value[row, kind] for name, value in prediction.items() if name not in ("finger", "type")}


def _depths(hand: Hand, count: int = 500) -> tuple[float, float]:
    """Return how near and how far along the palm's approach fingertips can touch, m, at postures drawn evenly."""
    lower, upper = hand.limits.double().unbind(-1)
    share = torch.from_numpy(stream(0, "depths").random((count, len(lower))))
    tips = hand.fingertips(lower + share * (upper - lower))[..., :3, 3] - hand.base_T_palm[:3, 3].double()
    radius = max(finger.tip_radius for finger in hand.fingers)
    along = tips @ hand.base_T_palm[:3, 2].double()
    return float(along.min()) - radius, float(along.max()) + radius
