"""The Representation interface: how a network tells a grasp."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from dexgrasp.batch import Batch
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand

Prediction = dict[str, Tensor]
"""Raw outputs of the heads by name; the first axis of each is the point."""


@dataclass(frozen=True)
class Targets(Batch):
    """What the network shall say at N points."""

    finger: Int[Tensor, "N"]
    """0 = not graspable, 1..F = the finger that touches here."""
    parameters: Float[Tensor, "N P"]
    """The representation's numbers (continuous, not binned); anything finite where `finger` is 0."""
    quality: Float[Tensor, "N"]
    """Epsilon quality of the labelled grasp, 0 where there is none."""
    encodable: Bool[Tensor, "N"]
    """Whether the grasp can be told at all; False is never trained on."""


class Representation(nn.Module, ABC):
    """Encoder, heads, loss and decoder of one way to tell a grasp.

    Constructor: ``(hand, channels, **options)``; `channels` is the size of the backbone's point features.
    Points and normals are in one frame (the camera's in training); that frame is the grasps' too.
    """

    hand: Hand
    size: int
    """Number P of parameters."""
    choices: int = 1
    """How many answers the heads can give at a point, likeliest first."""
    resolution: tuple[float, float] = (1e-5, 1e-4)
    """How far decode(encode) may move a grasp that can be told: m, rad."""

    def tip_contacts(self, finger: Int[Tensor, "N"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return where fingertips 0..F-1 are taken to touch a surface that lies in unit `directions` from them.

        Both in the tip frame (`Hand.fingertips`), the point in m; here the fingertip circle's ball. The laws try grasps
        that touch so.
        """
        radii = directions.new_tensor([each.tip_radius for each in self.hand.fingers])
        return radii[finger].unsqueeze(-1) * directions

    def prepare(self, grasps: Iterable[Grasps]) -> None:
        """Learn, before a training begins, what is learnt from grasps alone; here nothing.

        `grasps` are those of each of the dataset's objects, in its frame. What is learnt must be in the state dict.
        """

    @abstractmethod
    def encode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grasps: Grasps) -> Targets:
        """Tell N grasps, each from the point where the finger `grasps.finger` touches; no network involved."""

    @abstractmethod
    def decode(self, points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], prediction: Prediction) -> Grasps:
        """Return one grasp per point; `quality` is the score (probability of graspable), `finger` the likeliest.

        The fields `contacts` and `normals` hold the point for that finger and NaN for the others.
        """

    @abstractmethod
    def forward(self, features: Float[Tensor, "N C"], truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Run the heads on point features; `choice` of `choices` says which answer is wanted, 0 the likeliest.

        In training, `truth` is what the points are labelled with: heads that build on the answers of earlier heads may
        build on the true ones there (teacher forcing). Without it, they build on their own.
        """

    def answers(self, features: Float[Tensor, "N C"], count: int) -> Prediction:
        """Return the first `count` choices, in evaluation: all points' first, then all points' second, ..."""
        each = [self(features, choice=choice) for choice in range(count)]
        return {name: torch.cat([outputs[name] for outputs in each]) for name in each[0]}

    def graspable(self, features: Float[Tensor, "N C"]) -> Float[Tensor, "N"]:
        """Return, for each point, a number that grows with the score that `decode` gives; cheaper where one head tells.

        Where the score depends on where a point lies, a representation has to say this itself.
        """
        points = features.new_zeros(len(features), 3)
        normals = points + points.new_tensor([0.0, 0.0, 1.0])
        return self.decode(points, normals, self(features)).quality

    @abstractmethod
    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return the loss terms by name, weighted, each a scalar; their sum is minimised."""

    @abstractmethod
    def as_prediction(self, targets: Targets) -> Prediction:
        """Return the prediction that says exactly `targets`: what a perfect network would put out."""
