"""Points on a hand's surface, carried by its differentiable kinematics."""

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.hand import Hand
from dexgrasp.tip_surface import TipSurface

TIP, LINK = 24, 16
"""Points on each fingertip, and on each link."""


class HandPoints:
    """Fingertip and link surface points of a hand."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        tips = [points[:TIP] if len(points) else torch.zeros(TIP, 3) for _, points in TipSurface(hand).tips]
        self.tips = torch.stack([points.float() for points in tips])
        """(F, TIP, 3), tip frames, m; the circle's centre where a fingertip has no body."""
        self.links: dict[str, Float[Tensor, "LINK 3"]] = {}
        for name, parts in hand.collisions.items():
            whole = trimesh.util.concatenate(list(parts))
            points, _ = trimesh.sample.sample_surface(whole, LINK, seed=0)
            self.links[name] = torch.from_numpy(points).float()

    def __call__(
        self, base: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"]
    ) -> tuple[Float[Tensor, "N F T 3"], Float[Tensor, "N P 3"]]:
        """Return points on fingertips and on all links in the frame of `base` = frame_T_base, m."""
        tips = base.unsqueeze(1) @ self.hand.fingertips(joints)
        poses = self.hand.link_poses(joints)
        links = [_carried(base @ poses[name], points) for name, points in self.links.items()]
        return _carried(tips, self.tips), torch.cat(links, dim=1)


def _carried(motion: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*c T 3"]) -> Float[Tensor, "*b T 3"]:
    return points @ motion[..., :3, :3].mT + motion[..., None, :3, 3]
