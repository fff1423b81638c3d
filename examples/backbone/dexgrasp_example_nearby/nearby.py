"""The plainest backbone that obeys every law: one layer per point, averaged over nearby points."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from dexgrasp.backbone import Backbone, Plan
from dexgrasp.sampling import farthest_points


class Nearby(Backbone):
    """At each of `points` seeds: a linear layer and ReLU on its `neighbours` nearest points, their mean, one more."""

    def __init__(self, points: int = 1024, neighbours: int = 32, width: int = 64) -> None:
        super().__init__()
        self.points, self.neighbours, self.channels = points, neighbours, width
        self.each = nn.Sequential(nn.Linear(6, width), nn.ReLU())
        self.whole = nn.Sequential(nn.Linear(width, width), nn.ReLU())

    def plan(self, points: Tensor) -> Plan:
        """Return what depends on positions only: `seeds` (M,), as every plan has, and their neighbours (M, K)."""
        seeds = farthest_points(points, min(self.points, len(points)))
        count = min(self.neighbours, len(points))
        _, near = cKDTree(points.cpu().numpy()).query(points[seeds].cpu().numpy(), k=count)
        return {"seeds": seeds, "near": torch.from_numpy(near).reshape(len(seeds), count)}

    def forward(self, cloud: Tensor, plan: Plan | None = None) -> tuple[Tensor, Tensor]:
        """Return features (B, M, channels) and seeds (B, M) of clouds (B, N, 6)."""
        if plan is None:
            plans = [self.plan(points) for points in cloud[..., :3]]
            plan = {name: torch.stack([made[name] for made in plans]).to(cloud.device) for name in plans[0]}
        rows = torch.arange(len(cloud), device=cloud.device)[:, None]
        near = cloud[rows[..., None], plan["near"]]  # (B, M, K, 6)
        place = cloud[rows, plan["seeds"]][..., None, :3]
        about = torch.cat([near[..., :3] - place, near[..., 3:]], dim=-1)  # positions about the seed
        return self.whole(self.each(about).mean(dim=2)), plan["seeds"]
