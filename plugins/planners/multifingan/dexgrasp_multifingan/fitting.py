"""Training: the generator against the critic, and by what the true objects say of its grasps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.distance import DistanceField
from dexgrasp.geometry import axis_angle, inverse, pose
from dexgrasp.progress import track
from dexgrasp.seeds import torch_stream
from dexgrasp_multifingan import losses
from dexgrasp_multifingan.examples import Example
from dexgrasp_multifingan.hand_points import HandPoints
from dexgrasp_multifingan.networks import Networks
from dexgrasp_multifingan.taxonomy import taxonomy


@dataclass(frozen=True)
class Settings:
    """Of a fit; the keys of `conf/planner/multifingan.yaml`."""

    steps: int
    batch: int
    critic_steps: int
    learning_rate: float
    adversarial: float
    contact: float
    penetration: float
    orientation: float
    classification: float
    gradient_penalty: float


class Batch(NamedTuple):
    """Examples, each turned about the vertical by an angle of its own, and one true grasp of each."""

    cloud: Float[Tensor, "B P 7"]
    objects: list[int]
    frame_T_object: Float[Tensor, "B 4 4"]
    height: Float[Tensor, "B"]
    palm: Float[Tensor, "B 4 4"]
    joints: Float[Tensor, "B J"]
    kind: Int[Tensor, "B"]
    kinds: Float[Tensor, "B K"]
    """Share of each type in the example's grasps."""
    start: Float[Tensor, "B 3 3"]
    """The random turn from which the generator begins."""


def random_turns(count: int, generator: torch.Generator) -> Float[Tensor, "N 3 3"]:
    """Return palms' rotations: approaches even over the half of the sphere that does not come from below, any roll."""
    approach = F.normalize(torch.randn(count, 3, generator=generator), dim=1)
    approach[:, 2] = -approach[:, 2].abs()
    side = torch.randn(count, 3, generator=generator)
    x = F.normalize(side - (side * approach).sum(1, keepdim=True) * approach, dim=1)
    return torch.stack([x, torch.linalg.cross(approach, x), approach], dim=-1)


class Fitting:
    """One training of `networks` on `examples`, with the true objects' distance fields."""

    def __init__(
        self,
        networks: Networks,
        examples: Sequence[Example],
        field: Callable[[int], DistanceField],
        settings: Settings,
        seed: int,
    ) -> None:
        self.networks, self.examples, self.field, self.settings = networks, examples, field, settings
        self.points = HandPoints(networks.hand)
        self.generator = torch_stream(seed, "fit")
        self.palms = [example.base @ networks.base_T_palm for example in examples]
        joints = torch.cat([example.joints for example in examples])
        centres = inverse(torch.cat(self.palms))[:, :3, 3]
        touching: Bool[Tensor, "N F"] = torch.cat([example.touching for example in examples])
        count = len(networks.types_joints)
        types, own = taxonomy(joints, centres, touching, networks.ranges, count, seed)
        networks.types_joints.copy_(types.joints)
        networks.types_centre.copy_(types.centre)
        networks.types_touching.copy_(types.touching)
        self.kinds = own.split([len(example.base) for example in examples])
        self.shares = torch.stack([torch.bincount(kind, minlength=count) / len(kind) for kind in self.kinds])

    def run(self) -> dict[str, float]:
        """Train and return the mean of each loss over the last tenth of the steps (lengths in m)."""
        net, settings = self.networks, self.settings
        critic = [*net.critic_encoder.parameters(), *net.critic.parameters()]
        rest = [*net.encoder.parameters(), *net.classifier.parameters(), *net.generator.parameters()]
        critic_optimizer = torch.optim.Adam(critic, settings.learning_rate, betas=(0.5, 0.9))
        optimizer = torch.optim.Adam(rest, settings.learning_rate, betas=(0.5, 0.9))
        told: list[dict[str, float]] = []
        for step in track(range(settings.steps), "fit"):
            rate = settings.learning_rate * 0.5 * (1 + math.cos(math.pi * step / settings.steps))
            for each in (optimizer, critic_optimizer):
                each.param_groups[0]["lr"] = rate
            for _ in range(settings.critic_steps):
                critic_optimizer.zero_grad()
                self.critic_loss(self.batch()).backward()
                critic_optimizer.step()
            optimizer.zero_grad()
            terms = self.terms(self.batch())
            sum(getattr(settings, key) * value for key, value in terms.items()).backward()  # type: ignore[union-attr]
            optimizer.step()
            told.append({key: value.item() for key, value in terms.items()})
        last = told[-max(1, len(told) // 10) :]
        return {key: sum(each[key] for each in last) / len(last) for key in last[0]} if told else {}

    def batch(self) -> Batch:
        """Draw examples, a grasp of each, turns about the vertical and turns to begin from."""
        draw, count = self.generator, self.settings.batch
        rows = torch.randint(len(self.examples), (count,), generator=draw).tolist()
        some = [self.examples[row] for row in rows]
        picks = torch.rand(count, generator=draw).tolist()
        grasps = [int(pick * len(example.base)) for pick, example in zip(picks, some, strict=True)]
        yaw = 2 * math.pi * torch.rand(count, generator=draw)
        turn = axis_angle(torch.tensor([0.0, 0.0, 1.0]).expand(count, 3), yaw)
        motion = pose(turn, torch.zeros(count, 3))
        cloud = torch.stack([example.cloud for example in some])
        turned = [cloud[..., :3] @ turn.mT, cloud[..., 3:6] @ turn.mT, cloud[..., 6:]]
        chosen = list(zip(rows, grasps, strict=True))
        return Batch(
            torch.cat(turned, dim=-1),
            [example.object for example in some],
            motion @ torch.stack([example.frame_T_object for example in some]),
            torch.tensor([example.height for example in some]),
            motion @ torch.stack([self.palms[row][grasp] for row, grasp in chosen]),
            torch.stack([self.examples[row].joints[grasp] for row, grasp in chosen]),
            torch.stack([self.kinds[row][grasp] for row, grasp in chosen]),
            self.shares[rows],
            random_turns(count, draw),
        )

    def critic_loss(self, batch: Batch) -> Tensor:
        """Return the Wasserstein critic's loss with its gradient penalty."""
        net = self.networks
        with torch.no_grad():
            made = net.judged(*net.generate(net.encoder(batch.cloud), batch.kind, batch.start))
            real = net.judged(batch.palm, batch.joints)
        feature = net.critic_encoder(batch.cloud)
        mix = torch.rand(len(made), generator=self.generator)
        slope = losses.gradient_penalty(lambda grasp: net.judge(feature, grasp), real, made, mix)
        gap = net.judge(feature, made).mean() - net.judge(feature, real).mean()
        return gap + self.settings.gradient_penalty * slope

    def terms(self, batch: Batch) -> dict[str, Tensor]:
        """Return the losses of generator and classifier, by the name of their weight."""
        net = self.networks
        feature = net.encoder(batch.cloud)
        palm, joints = net.generate(feature, batch.kind, batch.start)
        tips, hand = self.points(net.base(palm), joints)
        both = torch.cat([tips.flatten(1, 2), hand], dim=1)
        distances = losses.surface_distance(both, batch.frame_T_object, batch.objects, self.field)
        of_tips, of_hand = distances.split([tips.shape[1] * tips.shape[2], hand.shape[1]], dim=1)
        heights = hand[..., 2] + batch.height.unsqueeze(1)
        score = net.judge(net.critic_encoder(batch.cloud), net.judged(palm, joints))
        return {
            "classification": F.cross_entropy(net.classifier(feature), batch.kinds),
            "adversarial": -score.mean(),
            "contact": losses.contact(of_tips.reshape(tips.shape[:3]), net.types_touching[batch.kind]).mean(),
            "penetration": losses.penetration(of_hand, heights).mean(),
            "orientation": losses.orientation(palm).mean(),
        }
