"""The U-shaped network and its plan of indices."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dexgrasp import kernels
from dexgrasp.backbone import Backbone, Plan
from dexgrasp.errors import DexgraspError
from dexgrasp.sampling import farthest_points, neighbours
from dexgrasp_pointnet2.layers import FeaturePropagation, SetAbstraction, mlp

HEIGHT = 10.0
"""Heights (m) times this are numbers of order one, as normals are."""


class PointNet2(Backbone):
    """PointNet++ with features at the points of its first level (METHOD section 3).

    Positions enter only relative to their ball's centre and by their height, so features do not change when a cloud is
    shifted sideways.

    Args:
        points: number of centres of each set abstraction level, falling; the first are the seeds.
        radii: ball radius of each level, m.
        neighbours: points taken of each ball: the nearest ones within the radius.
        widths: layer sizes of each level's MLP.
        decoder: layer sizes of each feature propagation, coarsest first; one less than levels.
        stem: size of a layer on the points' own inputs before the first level; 0 for none.
        height: the points' own inputs are normal and height (z); else the normal alone, as published.
        factorised: take the maximum behind each level's first layer (fast) instead of its last (as published).
        u_shape: propagate level by level with skip connections; otherwise the coarsest features are interpolated
            straight onto the seeds (the paper's ablation).
    """

    farthest_first = True

    def __init__(
        self,
        points: Sequence[int] = (2048, 512, 128, 32),
        radii: Sequence[float] = (0.02, 0.04, 0.08, 0.16),
        neighbours: Sequence[int] = (32, 16, 16, 16),
        widths: Sequence[Sequence[int]] = ((32, 32, 32), (64, 64, 64), (96, 96, 96), (128, 128, 128)),
        decoder: Sequence[Sequence[int]] = ((96,), (64,), (64,)),
        stem: int = 32,
        height: bool = True,
        factorised: bool = True,
        u_shape: bool = True,
    ) -> None:
        super().__init__()
        lengths = [len(points), len(radii), len(neighbours), len(widths), len(decoder) + 1]
        if len(set(lengths)) > 1 or not points:
            raise DexgraspError(
                "points, radii, neighbours and widths of one length and decoder one shorter",
                f"lengths {lengths[:-1]} and {len(decoder)}",
                "give every level of backbone=pointnet2 all of its numbers",
            )
        self.points, self.radii, self.neighbours = tuple(points), tuple(radii), tuple(neighbours)
        self.u_shape = u_shape
        outputs = [width[-1] for width in widths]
        self.height, inputs = height, 4 if height else 3
        self.stem = mlp((inputs, stem)) if stem else nn.Identity()
        self.encoder = nn.ModuleList(
            SetAbstraction(channels, width, factorised)
            for channels, width in zip([stem or inputs, *outputs], widths, strict=False)
        )
        if not u_shape:
            decoder = decoder[-1:]
        skips = outputs[-2::-1] if u_shape else [0] * len(decoder)
        coarse = [outputs[-1], *(width[-1] for width in decoder)]
        self.decoder = nn.ModuleList(
            FeaturePropagation(below, skip, width) for below, skip, width in zip(coarse, skips, decoder, strict=False)
        )
        self.channels = coarse[-1]

    def plan(self, points: Float[Tensor, "N 3"]) -> Plan:
        """Return `sample_i` (M_i,) and `group_i` (M_i, K_i), rows of level i - 1 (of the cloud for i = 0), and
        `up_i` (M_i, 3), rows of level i + 1 (of the last without the U-shape); int16 where that suffices."""
        small = torch.int16 if len(points) < 2**15 else torch.int32
        plan: Plan = {}
        levels = [points.detach().cpu()]
        for i, (count, radius, size) in enumerate(zip(self.points, self.radii, self.neighbours, strict=True)):
            sample = farthest_points(levels[i], min(count, len(levels[i])))
            levels.append(levels[i][sample])
            plan[f"sample_{i}"] = sample.to(small)
            plan[f"group_{i}"] = neighbours(levels[i], levels[i + 1], size, radius).to(small)
        for i in range(len(self.decoder)):
            coarse = levels[i + 2] if self.u_shape else levels[-1]
            plan[f"up_{i}"] = neighbours(coarse, levels[i + 1], 3).to(small)
        return {"seeds": plan["sample_0"].long(), **plan}

    def plans(self, points: Float[Tensor, "B N 3"]) -> Plan:
        """Return the stacked plans of a batch of clouds, on their device; int64 where kernels find them, on CUDA."""
        if not kernels.usable(points):
            return super().plans(points)
        plan: Plan = {}
        levels, arranged = [points.detach()], [kernels.arrange(points)]
        for i, (count, radius, size) in enumerate(zip(self.points, self.radii, self.neighbours, strict=True)):
            sample = plan[f"sample_{i}"] = arranged[i].farthest(min(count, levels[i].shape[1]))
            levels.append(levels[i].take_along_dim(sample.unsqueeze(-1), dim=1))
            plan[f"group_{i}"] = arranged[i].nearest(levels[i + 1], size, radius)
            arranged.append(kernels.arrange(levels[i + 1]))
        for i in range(len(self.decoder)):
            coarse = arranged[i + 2] if self.u_shape else arranged[-1]
            plan[f"up_{i}"] = coarse.nearest(levels[i + 1], 3)
        return {"seeds": plan["sample_0"], **plan}

    def forward(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None = None
    ) -> tuple[Float[Tensor, "B M C"], Int[Tensor, "B M"]]:
        if plan is None:
            plan = self.plans(cloud[..., :3])
        batch = len(cloud)

        levels = [cloud[..., :3].flatten(0, 1)]
        own = torch.cat([cloud[..., 3:], HEIGHT * cloud[..., 2:3]], dim=-1) if self.height else cloud[..., 3:]
        features = [self.stem(own.flatten(0, 1))]
        for i, layer in enumerate(self.encoder):
            size = levels[i].shape[0] // batch  # not len: an exported network takes clouds of any size
            centres = levels[i][_flat(plan[f"sample_{i}"], size)]
            features.append(layer(levels[i], features[i], centres, _flat(plan[f"group_{i}"], size)))
            levels.append(centres)

        coarse = features[-1]
        for layer, i in zip(self.decoder, reversed(range(len(self.decoder))), strict=True):
            below = levels[i + 2] if self.u_shape else levels[-1]
            nearest = _flat(plan[f"up_{i}"], len(below) // batch)
            coarse = layer(below, coarse, levels[i + 1], features[i + 1], nearest)
        return coarse.unflatten(0, (batch, -1)), plan["seeds"]


def _flat(index: Int[Tensor, "B *m"], size: int) -> Int[Tensor, "B*m"]:
    """Return the rows of a flattened batch of clouds of `size` points that an index per cloud means."""
    offset = torch.arange(len(index), device=index.device) * size
    return (index.long() + offset.reshape(-1, *[1] * (index.dim() - 1))).flatten(0, 1)
