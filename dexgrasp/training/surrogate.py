"""Foretelling what physics says of a grasp from how its fingers close on the true object."""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from dexgrasp.dataset.truth import Outcome
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.load_capacity import lifts
from dexgrasp.seeds import stream, torch_stream
from dexgrasp.threads import one_thread
from dexgrasp.training.descent import descend

FACTS = 17
"""Numbers by which a closed grasp is known, see `facts`."""
FEWEST = 200
"""Fewer verdicts teach nothing."""
MEMBERS, HIDDEN = 5, (64, 32)
EPOCHS, BATCH, RATE, DECAY, DROPOUT = 60, 256, 0.003, 0.05, 0.1
DEEP = 0.01
"""m: a hand that reaches farther into an object is known as one that reaches so far."""


class Surrogate(nn.Module):
    """Probability that a grasp lifts, learnt from those that were tried: the mean of several small networks.

    What a closed grasp holds says much of that, but not what a hand does to an object before it holds it: push it over,
    or away, or lift it by an end. Verdicts of physics know, and are dear; this tells them on to grasps that have none.
    """

    def __init__(self) -> None:
        super().__init__()
        sizes = (FACTS, *HIDDEN)
        self.members = nn.ModuleList(
            nn.Sequential(
                *(layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU(), nn.Dropout(DROPOUT))),
                nn.Linear(sizes[-1], 1),
            )
            for _ in range(MEMBERS)
        )
        self.register_buffer("middle", torch.zeros(FACTS))
        self.register_buffer("spread", torch.ones(FACTS))
        self.middle: Tensor
        self.spread: Tensor

    def forward(self, known: Float[Tensor, "N K"]) -> Float[Tensor, "N"]:
        """Return N probabilities of grasps of these `facts`."""
        scaled = (known - self.middle) / self.spread
        return torch.stack([member(scaled).squeeze(1).sigmoid() for member in self.members]).mean(dim=0)

    @classmethod
    @one_thread()
    def taught(cls, known: Float[Tensor, "N K"], lifted: Float[Tensor, "N"], seed: int) -> "Surrogate":
        """Return one that has learnt of N grasps whether they lifted (1 or 0)."""
        torch.manual_seed(int(stream(seed, "surrogate").integers(2**31)))
        surrogate = cls()
        surrogate.middle.copy_(known.mean(dim=0))
        surrogate.spread.copy_(known.std(dim=0) + 1e-6)
        scaled = (known - surrogate.middle) / surrogate.spread
        for number, member in enumerate(surrogate.members):

            def loss_of(rows: Int[Tensor, "B"], member: nn.Module = member) -> Float[Tensor, ""]:
                return F.binary_cross_entropy_with_logits(member(scaled[rows]).squeeze(1), lifted[rows])

            order = torch_stream(seed, "surrogate order", number)
            descend(member, loss_of, len(known), BATCH, EPOCHS, RATE, DECAY, order)
        return surrogate.eval()


def facts(hand: Hand, grasps: Grasps, found: Outcome) -> Float[Tensor, "N K"]:
    """Return what is known of grasps (level frame: z up, the table at 0) that closed as `found`.

    Clear or not; fingers that touch, and with their tips; depth in the object, m; epsilon; `lifts` of the capacity;
    weight (N), radius and height of the object; where the middle of the contacts is from its centre of mass, up and
    sideways, and the highest and the lowest contact; sum of the contacts' normals, length and vertical part; how the
    palm looks, 1 for up, and its height.
    """
    touching = ~found.contacts.isnan().any(dim=2)
    some, count = touching.any(dim=1), found.touched[:, None].clamp(min=1)
    off = torch.where(touching[..., None], found.contacts - found.com[:, None], 0.0)
    middle, outward = off.sum(dim=1) / count, torch.where(touching[..., None], found.normals, 0.0).sum(dim=1)
    top = torch.where(touching, off[..., 2], -torch.inf).amax(dim=1)
    bottom = torch.where(touching, off[..., 2], torch.inf).amin(dim=1)
    palm = grasps.pose.double() @ hand.base_T_palm.double()
    columns = [
        found.clear,
        found.touched,
        found.on_tip,
        found.penetration.clamp(max=DEEP),
        found.epsilon,
        lifts(found.capacity),
        found.weight,
        found.radius,
        found.com[:, 2],
        middle[:, 2],
        torch.linalg.vector_norm(middle[:, :2], dim=1),
        torch.where(some, top, 0.0),
        torch.where(some, bottom, 0.0),
        torch.linalg.vector_norm(outward, dim=1),
        outward[:, 2],
        palm[:, 2, 2],
        palm[:, 2, 3],
    ]
    return torch.stack([column.float() for column in columns], dim=1)
