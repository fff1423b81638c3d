"""The fingertips' surfaces as support maps: which point of a fingertip is farthest in a direction."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.geometry import inverse
from dexgrasp.hand import Finger, Hand, tip_frame

REACH = 1.25
"""The fingertip reaches so many radii about the circle's centre, seen along the closing axis; as in closing."""
SIDES = 16
"""Of the prism by which the fingertip is cut off its link."""
FLAT = 2e-4
"""Corners whose heights differ by less than about this touch together: their mean is told, which smooths facets, m."""


class TipSurface:
    """Support maps of a hand's fingertips.

    A fingertip is what of its link's convex parts lies within `REACH` radii of its circle's axis, or, of a link without
    parts, the circle's ball. Tip frame: `Hand.fingertips`, origin at the circle's centre, axes [u, w x u, w].
    """

    def __init__(self, hand: Hand) -> None:
        self.tips = [_corners(hand, finger) for finger in hand.fingers]
        """Corners of each, in the tip frame, m, float64."""
        self.radii = [finger.tip_radius for finger in hand.fingers]

    def support(self, finger: Int[Tensor, "N"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Return the points of fingertips (m) that are farthest in unit directions, both in the tip frame.

        The middle of a flat that faces the direction, weighing its corners smoothly by how far out they are.
        """
        found = torch.empty_like(directions)
        for index, (tip, radius) in enumerate(zip(self.tips, self.radii, strict=True)):
            rows = (finger == index).nonzero().flatten()
            towards, corners = directions[rows], tip.to(directions)
            weights = (towards @ corners.T / FLAT).softmax(-1)
            found[rows] = weights @ corners if len(tip) else radius * towards
        return found


def _corners(hand: Hand, finger: Finger) -> Float[Tensor, "K 3"]:
    """Return the corners of a fingertip in the tip frame; none where its link has no parts."""
    tip_T_link = inverse(tip_frame(finger)).numpy()
    reach, turn = REACH * finger.tip_radius, np.arange(SIDES) * 2 * np.pi / SIDES
    outward = np.stack([np.cos(turn), np.sin(turn), np.zeros(SIDES)], axis=1)
    found = [np.empty((0, 3))]
    for part in hand.collisions.get(finger.link, ()):
        cut = trimesh.convex.convex_hull(trimesh.transform_points(part.vertices, tip_T_link))
        cut = cut.slice_plane(reach * outward, -outward)  # no caps: of the cut, too, the corners are all that counts
        found.append(np.asarray(cut.vertices).reshape(-1, 3))
    return torch.from_numpy(np.unique(np.concatenate(found), axis=0))
