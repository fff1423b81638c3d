"""The fingertips' surfaces as support maps: which point of a fingertip is farthest in a direction."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.geometry import inverse
from dexgrasp.hand import Finger, Hand

REACH = 1.25
"""The fingertip reaches so many radii about the circle's centre, seen along the closing axis; as in closing."""
SIDES = 16
"""Of the prism by which the fingertip is cut off its link."""
SAMPLES = 1500
"""Points drawn on each fingertip's surface, by which its touching part is found."""
FLAT = 4e-4
"""What is lower than the farthest point by less than about this touches too: its middle is told, m."""
BLOCK = 128
"""Directions that are looked at together: their heights stay in the cache."""


class TipSurface:
    """Support maps of a hand's fingertips.

    A fingertip is what of its link's convex parts lies within `REACH` radii of its circle's axis, or, of a link without
    parts, the circle's ball. Tip frame: `Hand.fingertips`, origin at the circle's centre, axes [u, w x u, w].
    """

    def __init__(self, hand: Hand) -> None:
        self.tips = [_surface(hand, finger) for finger in hand.fingers]
        """Corners and evenly drawn points of each, in the tip frame, m, float64."""
        self.radii = [finger.tip_radius for finger in hand.fingers]

    def support(self, finger: Int[Tensor, "N"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return the points of fingertips (m) that are farthest in unit directions, both in the tip frame.

        As far out as the farthest corner, and there the middle of what is within `FLAT` of it, so that facets are
        smoothed over and a flat that faces the direction touches with its middle.
        """
        found = torch.empty_like(directions)
        for index, ((corners, points), radius) in enumerate(zip(self.tips, self.radii, strict=True)):
            rows = (finger == index).nonzero().flatten()
            towards = directions[rows]
            if not len(corners):
                found[rows] = radius * towards
                continue
            corner, point = corners.to(directions), points.to(directions)
            for some, part in zip(rows.split(BLOCK), towards.split(BLOCK), strict=True):
                height = (part @ corner.T).amax(-1, keepdim=True)
                middle = (part / FLAT @ point.T).softmax(-1) @ point
                found[some] = middle + (height - (middle * part).sum(-1, keepdim=True)) * part
        return found


def _surface(hand: Hand, finger: Finger) -> tuple[Float[Tensor, "K 3"], Float[Tensor, "S 3"]]:
    """Return corners and drawn points of a fingertip in the tip frame; none where its link has no parts."""
    tip_T_link = inverse(finger.tip_frame).numpy()
    reach, turn = REACH * finger.tip_radius, np.arange(SIDES) * 2 * np.pi / SIDES
    outward = np.stack([np.cos(turn), np.sin(turn), np.zeros(SIDES)], axis=1)
    parts = []
    for part in hand.collisions.get(finger.link, ()):
        cut = trimesh.convex.convex_hull(trimesh.transform_points(part.vertices, tip_T_link))
        cut = cut.slice_plane(reach * outward, -outward)  # without caps: no part of the fingertip's surface
        parts += [cut] if len(cut.faces) else []
    if not parts:
        nothing = torch.empty(0, 3, dtype=torch.float64)
        return nothing, nothing
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    points, _ = trimesh.sample.sample_surface(whole, SAMPLES, seed=0)
    return torch.from_numpy(np.array(whole.vertices)), torch.from_numpy(np.array(points))
