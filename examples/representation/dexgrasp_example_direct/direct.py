"""The plainest representation that obeys every law: regression of offset, rotation and joints."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp import geometry
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import CERTAIN, contact_points, finger_loss, known_points, mean, told_grasps
from dexgrasp.representation import Prediction, Representation, Targets

TINY = 1e-9
"""Keeps a rotation defined where the network says nothing but zeros."""


class Direct(Representation):
    """Parameters: offset from the point to the base (3, in `scale`), two columns of its rotation (6), joints (J).

    Joints are told as parts of their ranges, about the middle. Constructor: (hand, channels, **options of the YAML).
    """

    label_options = ("scale",)
    """Options on which the numbers in `Targets` depend: labels are made anew when one changes."""

    def __init__(self, hand: Hand, channels: int, *, hidden: int = 128, scale: float = 0.1) -> None:
        super().__init__()
        self.hand, self.scale = hand, scale
        self.size = 9 + len(hand.joint_names)
        low, high = hand.limits.T
        self.register_buffer("middle", (low + high) / 2)
        self.register_buffer("span", (high - low).clamp(min=1e-6))
        self.trunk = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU())
        self.finger = nn.Linear(hidden, len(hand.fingers) + 1)
        self.numbers = nn.Linear(hidden, self.size)

    def encode(self, points: Tensor, normals: Tensor, grasps: Grasps) -> Targets:
        """Tell N grasps, each from the point where the finger `grasps.finger` touches."""
        grasps = grasps.to(points)
        offset = (grasps.pose[:, :3, 3] - points) / self.scale
        columns = grasps.pose[:, :3, :2].transpose(1, 2).flatten(1)
        joints = (grasps.joints - self.middle.to(points)) / self.span.to(points)
        return Targets(
            finger=grasps.finger + 1,  # 0 is for points that are not graspable
            parameters=torch.cat([offset, columns, joints], dim=1),
            quality=grasps.quality,
            encodable=(grasps.finger >= 0) & grasps.touching.all(dim=1),  # which fingers touch is not told
        )

    def decode(self, points: Tensor, normals: Tensor, prediction: Prediction) -> Grasps:
        """Return one grasp per point; its quality is the probability that the point is graspable."""
        logits, numbers = prediction["finger"].to(points), prediction["numbers"].to(points)
        offset, columns, joints = numbers.split([3, 6, len(self.hand.joint_names)], dim=1)
        pose = geometry.pose(_rotation(columns), points + self.scale * offset)
        joints = self.hand.clamp(self.middle.to(points) + self.span.to(points) * joints)
        finger = logits[:, 1:].argmax(dim=1)
        return told_grasps(self.hand, points, normals, finger, pose, joints, 1 - logits.softmax(dim=1)[:, 0])

    def forward(self, features: Tensor, truth: Targets | None = None, choice: int = 0) -> Prediction:
        """Run the heads on point features (N, channels)."""
        hidden = self.trunk(features)
        return {"finger": self.finger(hidden), "numbers": self.numbers(hidden)}

    def loss(self, prediction: Prediction, targets: Targets) -> dict[str, Tensor]:
        """Return the terms `finger` and `numbers`; the latter counts contact points only."""
        known, contact = known_points(targets), contact_points(targets)
        error = prediction["numbers"][contact].to(targets.parameters) - targets.parameters[contact]
        return {
            "finger": finger_loss(prediction["finger"][known], targets.finger[known]),
            "numbers": mean(error.square()),
        }

    def as_prediction(self, targets: Targets) -> Prediction:
        """Return what a perfect network would put out."""
        classes = F.one_hot(targets.finger, len(self.hand.fingers) + 1)
        return {"finger": CERTAIN * classes.to(targets.parameters), "numbers": targets.parameters}


def _rotation(columns: Tensor) -> Tensor:
    """Return rotations (N, 3, 3) from their first two columns (N, 6), made orthonormal."""
    eye = torch.eye(3).to(columns)
    x = F.normalize(columns[:, :3] + TINY * eye[0], dim=1)
    y = columns[:, 3:] - (columns[:, 3:] * x).sum(1, keepdim=True) * x
    y = F.normalize(y + TINY * torch.linalg.cross(x, eye[x.abs().argmin(dim=1)]), dim=1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=2)
