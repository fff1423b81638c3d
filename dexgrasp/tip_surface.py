"""The fingertips' surfaces as support maps: which point of a fingertip is farthest in a direction."""

import math

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from dexgrasp.device import takes_compiled
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
        compiled = takes_compiled(directions) and not directions.requires_grad
        for index, ((corners, points), radius) in enumerate(zip(self.tips, self.radii, strict=True)):
            rows = (finger == index).nonzero().flatten()
            towards = directions[rows]
            if not len(corners):
                found[rows] = radius * towards
                continue
            farthest = _compiled if compiled else farthest_reference
            found[rows] = farthest(towards, corners.to(directions), points.to(directions))
        return found


def farthest_reference(
    towards: Float[Tensor, "N 3"], corners: Float[Tensor, "K 3"], points: Float[Tensor, "S 3"]
) -> Float[Tensor, "N 3"]:
    """Return the points farthest in unit directions, as `TipSurface.support` says, in plain torch."""
    height = (towards @ corners.T).amax(-1, keepdim=True)
    middle = ((towards @ points.T - height) / FLAT).softmax(-1) @ points
    return middle + (height - (middle * towards).sum(-1, keepdim=True)) * towards


def _compiled(
    towards: Float[Tensor, "N 3"], corners: Float[Tensor, "K 3"], points: Float[Tensor, "S 3"]
) -> Float[Tensor, "N 3"]:
    out = torch.empty_like(towards)
    one, other = (np.ascontiguousarray(part.numpy().T) for part in (corners, points))
    _farthest(towards.detach().contiguous().numpy(), one, other, np.float32(1 / (FLAT * math.log(2))), out.numpy())
    return out


@njit(cache=True, fastmath=True)
def _farthest(towards: np.ndarray, corners: np.ndarray, points: np.ndarray, scale: np.float32, out: np.ndarray) -> None:
    """Weigh points by 2 ** (`scale` times their depth below the farthest corner); three loops that vectorise."""
    x, y, z = points[0], points[1], points[2]
    u, v, w = corners[0], corners[1], corners[2]
    rest, whole = np.empty(len(x), np.float32), np.empty(len(x), np.int32)
    power, least, half = whole.view(np.float32), np.float32(-126), np.float32(0.5)
    for i in range(len(towards)):
        a, b, c = towards[i, 0], towards[i, 1], towards[i, 2]
        top = a * u[0] + b * v[0] + c * w[0]
        for k in range(len(u)):
            height = a * u[k] + b * v[k] + c * w[k]
            top = height if height > top else top
        for k in range(len(x)):
            depth = (a * x[k] + b * y[k] + c * z[k] - top) * scale
            depth = depth if depth > least else least
            nearest = np.int32(depth - half)
            rest[k] = depth - np.float32(nearest)
            whole[k] = (nearest + np.int32(127)) << np.int32(23)  # the bits of 2 ** nearest
        total, p, q, r = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for k in range(len(x)):
            t = rest[k]  # within 1/2 of 0, where six terms of the exponential's series tell float32 exactly
            weight = np.float32(0.009618129) + t * (np.float32(0.0013333558) + t * np.float32(0.00015403530))
            weight = np.float32(0.24022651) + t * (np.float32(0.055504109) + t * weight)
            weight = (np.float32(1) + t * (np.float32(0.69314718) + t * weight)) * power[k]
            total += weight
            p += weight * x[k]
            q += weight * y[k]
            r += weight * z[k]
        p, q, r = p / total, q / total, r / total
        above = top - (p * a + q * b + r * c)
        out[i, 0], out[i, 1], out[i, 2] = p + above * a, q + above * b, r + above * c


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
