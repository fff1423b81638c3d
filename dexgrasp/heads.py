"""Heads on point features: small MLPs, and joint angles told as bin + residual (METHOD section 2)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.representation import Prediction, Targets

CERTAIN = 100.0
"""Logit of the true class in `as_prediction`: its probability is 1 in float32."""


Step = nn.Module | tuple[Tensor, Tensor]
"""A layer, or weight and bias of a linear one."""


class Layers(nn.Sequential):
    """Layers in a row. In evaluation on a CPU, a linear layer and the batch norm behind it are one multiplication."""

    _state: Sequence[tuple[int, int]] = ()
    """Memory and version of all weights when `_kept` was made."""
    _kept: Sequence[Step] = ()
    """What they are when joined."""

    def forward(self, *parts: Float[Tensor, "_ _"]) -> Float[Tensor, "N D"]:
        """Return (N, D) for columns of the input in parts; what has fewer rows than N stands for its repetition.

        All its rows, then all once more, ...; in evaluation on a CPU they are multiplied but once.
        """
        if self.training or parts[0].device.type != "cpu":  # a GPU's time goes by the number of launches
            return super().forward(beside(parts))
        # An exported network has rows of any number, which can't be told apart.
        if torch.compiler.is_compiling() or len({part.shape[0] for part in parts}) == 1:
            return next(self.in_pieces([beside(parts)]))
        first, *rest = self._steps()
        assert isinstance(first, tuple)
        return _run(rest, _linear(first, parts))

    def in_pieces(self, pieces: Iterable[Tensor]) -> Iterator[Tensor]:
        """Yield what evaluation makes of each of some (N, C) rows: (N, D). The weights are joined but once."""
        steps = self._steps()
        for rows in pieces:
            yield _run(steps, rows)

    def _steps(self) -> Sequence[Step]:
        if torch.is_grad_enabled() or torch.compiler.is_compiling():
            return self._joined()
        # Joining takes as long as multiplying a few hundred rows: it is done again only where a weight has changed.
        parts = self.state_dict(keep_vars=True).values()
        if any(part.is_inference() for part in parts):  # these do not tell when they change
            return self._joined()
        state = [(part.data_ptr(), part._version) for part in parts]
        if self._state != state:
            self._state, self._kept = state, self._joined()
        return self._kept

    def _joined(self) -> list[Step]:
        steps: list[Step] = []
        for layer, following in zip(self, [*list(self)[1:], None], strict=False):
            if isinstance(layer, nn.Linear):
                joined = folded(layer, following) if isinstance(following, nn.BatchNorm1d) else None
                steps.append(joined or (layer.weight, layer.bias))
            elif not isinstance(layer, nn.BatchNorm1d):
                steps.append(layer)
        return steps


def beside(parts: Sequence[Float[Tensor, "_ _"]]) -> Float[Tensor, "N C"]:
    """Join columns; what has fewer rows than others is repeated as a whole."""
    if len(parts) == 1:
        return parts[0]
    rows = max(part.shape[0] for part in parts)
    return torch.cat([part if (own := part.shape[0]) == rows else part.repeat(rows // own, 1) for part in parts], dim=1)


def _run(steps: Iterable[Step], rows: Tensor) -> Tensor:
    for step in steps:
        if isinstance(step, tuple):
            rows = F.linear(rows, *step)
        else:  # behind a linear layer: its own memory
            rows = F.relu_(rows) if isinstance(step, nn.ReLU) else step(rows)
    return rows


def _linear(layer: tuple[Tensor, Tensor], parts: Sequence[Float[Tensor, "_ _"]]) -> Float[Tensor, "N D"]:
    """Return the product of `beside(parts)`; parts of fewer rows are multiplied once and added to each repetition."""
    columns, bias = layer[0].split([part.shape[1] for part in parts], dim=1), layer[1]
    total = None
    for count in sorted({len(part) for part in parts}):
        some = [k for k, part in enumerate(parts) if len(part) == count]
        weight, rows = (torch.cat([each[k] for k in some], dim=1) for each in (columns, parts))
        if total is None:
            total = F.linear(rows, weight, bias)
        else:
            total = (F.linear(rows, weight).unflatten(0, (-1, len(total))) + total).flatten(0, 1)
    assert total is not None
    return total


def folded(layer: nn.Linear, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return weight and bias of a linear layer and the batch norm behind it, with its running statistics."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    shift = norm.running_mean if layer.bias is None else norm.running_mean - layer.bias
    return layer.weight * scale.unsqueeze(1), norm.bias - shift * scale


def mlp(channels: int, hidden: Sequence[int], out: int) -> Layers:
    """Return linear, batch norm, ReLU per hidden layer and a linear layer on top (no bias under a batch norm)."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(channels, width, bias=False), nn.BatchNorm1d(width), nn.ReLU(inplace=True)]
        channels = width
    return Layers(*layers, nn.Linear(channels, out))


class Heads(nn.Module):
    """Named outputs of one stage. ``separate`` gives each its own MLP (the paper); else they share hidden layers."""

    def __init__(self, channels: int, sizes: Mapping[str, int], hidden: Sequence[int], *, separate: bool) -> None:
        super().__init__()
        self.sizes = dict(sizes)
        outputs = list(self.sizes.values()) if separate else [sum(self.sizes.values())]
        self.layers = nn.ModuleList(mlp(channels, hidden, out) for out in outputs if out > 0)

    def forward(self, *features: Float[Tensor, "_ _"]) -> dict[str, Tensor]:
        """Return (N, size) per name; for `features` in parts see `Layers.forward`."""
        nothing = max(features, key=len)[:, :0] if len(features) > 1 else features[0][:, :0]
        joined = torch.cat([nothing, *(layer(*features) for layer in self.layers)], dim=-1)
        return dict(zip(self.sizes, joined.split(list(self.sizes.values()), dim=-1), strict=True))


class JointBins(nn.Module):
    """How the independent joints of a hand are told: a bin and a residual in it, in [-1/2, 1/2] of its width.

    Joints of zero range say nothing (no bins); joints whose range is a full turn wrap. All functions take `joint`,
    the index of the joint that each of S slots means at each of N points, because the meaning of a slot may depend
    on the finger that touches.

    Args:
        hand: gives ranges and names.
        bins: number of bins of a joint.
        shared: number of bins of a joint that is main for every finger (a spread joint).
        by_joint: number of bins of single joints by name, in place of both.
    """

    def __init__(
        self, hand: Hand, *, bins: int = 7, shared: int = 12, by_joint: Mapping[str, int] | None = None
    ) -> None:
        super().__init__()
        chosen = dict(by_joint or {})
        unknown = sorted(set(chosen) - set(hand.joint_names))
        if unknown or min([bins, shared, *chosen.values()]) < 1:
            raise DexgraspError(
                f"bin counts of at least 1 for joints of {hand.name}: {', '.join(hand.joint_names)}",
                f"bins={bins}, shared_bins={shared}, joint_bins={chosen}",
                "mend these options of the representation",
            )
        common = shared_joints(hand)
        lower, upper = hand.limits.double().unbind(-1)
        counts = [chosen.get(name, shared if name in common else bins) for name in hand.joint_names]
        count = torch.where(upper > lower, torch.tensor(counts), 0)
        self.most = max(1, int(count.max()))
        # Not persistent: they are the hand's and the options', not learnt.
        self.register_buffer("lower", lower.clone(), persistent=False)
        self.register_buffer("width", (upper - lower) / count.clamp(min=1), persistent=False)
        self.register_buffer("count", count, persistent=False)
        self.register_buffer("continuous", upper - lower >= 2 * torch.pi - 1e-6, persistent=False)
        self.lower: Tensor
        self.width: Tensor
        self.count: Tensor
        self.continuous: Tensor

    def split(
        self, angles: Float[Tensor, "N S"], joint: Int[Tensor, "N S"]
    ) -> tuple[Int[Tensor, "N S"], Float[Tensor, "N S"]]:
        """Return bin and residual of joint angles (rad); clamped to the range, or wrapped where it is a full turn."""
        lower, width, count = self.lower[joint].to(angles), self.width[joint].to(angles), self.count[joint]
        turn = torch.where(self.continuous[joint], torch.remainder(angles - lower, 2 * torch.pi), angles - lower)
        steps = turn / torch.where(width > 0, width, 1)
        index = torch.minimum(steps.floor().long().clamp(min=0), (count - 1).clamp(min=0))
        return index, (steps - index - 0.5).clamp(-0.5, 0.5)

    def join(
        self, logits: Float[Tensor, "N S B"], residuals: Float[Tensor, "N S B"], joint: Int[Tensor, "N S"]
    ) -> Float[Tensor, "N S"]:
        """Return the angles (rad) of the likeliest bins and their residuals, always within the limits."""
        lower, width = self.lower[joint].to(residuals), self.width[joint].to(residuals)
        index = self.likeliest(logits, joint)
        residual = residuals.gather(-1, index.unsqueeze(-1)).squeeze(-1).clamp(-0.5, 0.5)
        return lower + (index + 0.5 + residual) * width

    def likeliest(self, logits: Float[Tensor, "N S B"], joint: Int[Tensor, "N S"]) -> Int[Tensor, "N S"]:
        """Return the likeliest bin of each slot."""
        return self._masked(logits, joint).argmax(-1)

    def loss(
        self,
        logits: Float[Tensor, "N S B"],
        residuals: Float[Tensor, "N S B"],
        angles: Float[Tensor, "N S"],
        joint: Int[Tensor, "N S"],
        *,
        huber: float = 1.0,
    ) -> Float[Tensor, "N S"]:
        """Return cross-entropy on the bin + Huber on the residual of the true bin (paper equations 9 and 10)."""
        index, residual = self.split(angles, joint)
        bins = F.cross_entropy(self._masked(logits, joint).flatten(0, 1), index.flatten(), reduction="none")
        told = residuals.gather(-1, index.unsqueeze(-1)).squeeze(-1)
        rest = F.smooth_l1_loss(told.to(residual), residual, reduction="none", beta=huber)
        return (bins.view_as(rest) + rest) * (self.count[joint] > 0)

    def as_prediction(
        self, angles: Float[Tensor, "N S"], joint: Int[Tensor, "N S"]
    ) -> tuple[Float[Tensor, "N S B"], Float[Tensor, "N S B"]]:
        """Return logits and residuals that say exactly `angles`."""
        index, residual = self.split(angles, joint)
        logits = CERTAIN * F.one_hot(index, self.most).to(angles)
        return logits, residual.unsqueeze(-1).expand_as(logits).contiguous()

    def _masked(self, logits: Tensor, joint: Tensor) -> Tensor:
        """Rule out the bins that a joint with fewer than the most does not have."""
        absent = torch.arange(self.most, device=joint.device) >= self.count[joint].clamp(min=1).unsqueeze(-1)
        return logits.masked_fill(absent, torch.finfo(logits.dtype).min)


def shared_joints(hand: Hand) -> tuple[str, ...]:
    """Return the joints that are main for every finger, in the hand's order (a BarrettHand's spread)."""
    return tuple(name for name in hand.joint_names if all(name in finger.main for finger in hand.fingers))


def finger_loss(
    logits: Float[Tensor, "N K"], classes: Int[Tensor, "N"], *, none_weight: float = 1.0, focal: float = 0.0
) -> Tensor:
    """Return the mean cross-entropy over none (class 0) and fingers; 0 for no point.

    `none_weight` weighs the points of class 0 against the graspable ones; ``focal > 0`` turns points that are told
    well already down by (1 - p)^focal (Lin et al. 2017, focal loss).
    """
    log_p = F.log_softmax(logits, dim=-1).gather(-1, classes.unsqueeze(-1)).squeeze(-1)
    weight = torch.where(classes == 0, none_weight, 1.0).to(log_p)
    loss = -log_p if focal == 0 else -log_p * (1 - log_p.exp()).clamp(min=1e-6).pow(focal)
    return (weight * loss).sum() / weight.sum().clamp(min=1e-6)


def any_finger(logits: Float[Tensor, "N K"]) -> Float[Tensor, "N"]:
    """Return the logit of the probability that a point is graspable, of the classes none and fingers."""
    return logits[:, 1:].logsumexp(dim=-1) - logits[:, 0]


def told_grasps(
    hand: Hand,
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    finger: Int[Tensor, "N"],
    pose: Float[Tensor, "N 4 4"],
    joints: Float[Tensor, "N J"],
    score: Float[Tensor, "N"],
    touching: Bool[Tensor, "N F"] | None = None,
) -> Grasps:
    """Return decoded grasps, whose contact with `finger` is the point; those of the other fingers are NaN."""
    grasps = Grasps.build(pose, joints, len(hand.fingers), finger=finger, quality=score, touching=touching)
    touching = F.one_hot(finger, len(hand.fingers)).bool().unsqueeze(-1)
    return grasps.replace(
        contacts=torch.where(touching, points.unsqueeze(1), grasps.contacts),
        normals=torch.where(touching, normals.unsqueeze(1), grasps.normals),
    )


def of_finger(prediction: Prediction, finger: Int[Tensor, "N"]) -> Prediction:
    """Return all outputs but `finger` for the finger that touches; those (N, 1, ...) are the same for every finger."""
    row = torch.arange(len(finger), device=finger.device)
    outputs = {name: value for name, value in prediction.items() if name != "finger"}
    return {name: value[row, finger] if value.shape[1] > 1 else value[:, 0] for name, value in outputs.items()}


def every_finger(outputs: Prediction, versions: int) -> Prediction:
    """Return outputs (N, ...) as `versions` equal ones each, (N, versions, ...); the inverse of `of_finger`."""
    return {name: torch.stack([value] * versions, dim=1) for name, value in outputs.items()}


def known_points(targets: Targets) -> Int[Tensor, "K"]:
    """Return the rows that the finger's loss counts: all but grasps that cannot be told."""
    return ((targets.finger == 0) | targets.encodable).nonzero().flatten()


def contact_points(targets: Targets) -> Int[Tensor, "K"]:
    """Return the rows that all other losses count: grasps that can be told."""
    return ((targets.finger > 0) & targets.encodable).nonzero().flatten()


def mean(losses: Float[Tensor, "K *r"]) -> Tensor:
    """Return the mean over points of the sum over all else; 0, with a gradient of 0, for no point."""
    return losses.sum() / max(1, len(losses))
