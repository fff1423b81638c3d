"""The networks: an object's feature and grasp type, the generator that refines, the critic that tells true grasps."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dexgrasp.geometry import inverse, orthonormal, pose
from dexgrasp.hand import Hand

UNIT = 0.1
"""Of lengths that networks see, m."""


def mlp(*widths: int) -> nn.Sequential:
    """Return linear layers with leaky rectifiers between them."""
    layers = [[nn.Linear(a, b), nn.LeakyReLU(0.1)] for a, b in pairwise(widths)]
    return nn.Sequential(*[layer for pair in layers for layer in pair][:-1])


class PointNet(nn.Module):
    """Feature of an object's cloud (Qi et al. 2017): an MLP on each point, the maximum, an MLP."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.each, self.all = mlp(7, 64, channels), mlp(channels, channels, channels)

    def forward(self, cloud: Float[Tensor, "B P 7"]) -> Float[Tensor, "B C"]:
        """Return features of clouds of position about the middle (in `UNIT`), normal and height above the table."""
        return self.all(self.each(cloud).amax(1))


class Networks(nn.Module):
    """All that is learnt, and the hand's types.

    Object frame: z up, origin in the middle of what is seen of the object. Hands are told by their palm frame there.
    """

    types_joints: Tensor
    types_centre: Tensor
    types_touching: Tensor

    def __init__(self, hand: Hand, types: int, channels: int, hidden: int) -> None:
        super().__init__()
        self.hand = hand
        count, fingers = len(hand.joint_names), len(hand.fingers)
        self.encoder, self.critic_encoder = PointNet(channels), PointNet(channels)
        self.classifier = mlp(channels, hidden, types)
        self.generator = mlp(channels + types + 9 + count, hidden, hidden, 9 + count)
        self.critic = mlp(channels + 9 + count + 3 * fingers, hidden, hidden, 1)
        self.register_buffer("types_joints", torch.zeros(types, count))
        self.register_buffer("types_centre", torch.zeros(types, 3))
        self.register_buffer("types_touching", torch.ones(types, fingers, dtype=torch.bool))
        lower, upper = hand.limits.float().unbind(-1)
        self.lower, self.ranges = lower, torch.where(upper > lower, upper - lower, 1.0)
        self.base_T_palm = hand.base_T_palm.float()
        with torch.no_grad():  # begin at the coarse grasp
            self.generator[-1].weight.mul_(0.1)
            self.generator[-1].bias.zero_()

    def generate(
        self, feature: Float[Tensor, "B C"], kind: Tensor, turn: Float[Tensor, "B 3 3"]
    ) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B J"]]:
        """Return object_T_palm and joints: the coarse grasp of a type, turned as told, refined.

        The coarse one has the type's mean posture, and the object's middle where it lies on average in such hands.
        """
        joints, centre = self.types_joints[kind], self.types_centre[kind]
        place = -(turn @ centre.unsqueeze(-1)).squeeze(-1)
        chosen = nn.functional.one_hot(kind, len(self.types_joints)).float()
        told = torch.cat([feature, chosen, self.told(pose(turn, place), joints)], dim=1)
        shift, columns, bend = self.generator(told).split([3, 6, joints.shape[1]], dim=1)
        by = orthonormal(columns + columns.new_tensor([1.0, 0, 0, 0, 1, 0]))
        refined = joints + 0.5 * torch.tanh(bend) * self.ranges
        return pose(turn @ by, place + UNIT * shift), self.hand.clamp(refined)

    def told(self, palm: Float[Tensor, "B 4 4"], joints: Float[Tensor, "B J"]) -> Float[Tensor, "B 9+J"]:
        """Return a grasp as numbers of about one."""
        share = 2 * (joints - self.lower) / self.ranges - 1
        return torch.cat([palm[:, :3, 3] / UNIT, palm[:, :3, 0], palm[:, :3, 1], share], dim=1)

    def judge(self, feature: Float[Tensor, "B C"], grasp: Float[Tensor, "B 9+J+3F"]) -> Float[Tensor, "B"]:
        """Return the critic's score, higher for what looks like a true grasp of that object."""
        return self.critic(torch.cat([feature, grasp], dim=1)).squeeze(1)

    def judged(self, palm: Float[Tensor, "B 4 4"], joints: Float[Tensor, "B J"]) -> Float[Tensor, "B 9+J+3F"]:
        """Return what the critic sees of a grasp: `told`, and the fingertips in the object frame."""
        tips = self.base(palm).unsqueeze(1) @ self.hand.fingertips(joints)
        return torch.cat([self.told(palm, joints), tips[..., :3, 3].flatten(1) / UNIT], dim=1)

    def base(self, palm: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 4 4"]:
        """Return object_T_base of palms."""
        return palm @ inverse(self.base_T_palm)
