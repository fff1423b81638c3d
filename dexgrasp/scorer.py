"""How likely a proposed grasp is to lift: a second opinion on what the representation's heads have told."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor, nn

from dexgrasp.geometry import transform
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.heads import Layers, mlp
from dexgrasp.sampling import farthest_points

COARSE, NEAREST = 512, 64
"""Of so many points, spread evenly over the scene, a grasp is judged by the ones nearest to the middle of its tips."""
FINE, AT_TIP = 2048, 16
"""And of so many by the ones nearest to each fingertip."""
PIECE = 32
"""Hands whose surroundings are looked at together in evaluation."""
BLOCK = 32
"""Points that are passed over together where none of them is near."""
REACH, TIP_REACH = 0.1, 0.03
"""Offsets and heights (m) in units of this are numbers of order one; about a fingertip, of the other."""


class Scorer(nn.Module):
    """Logit of the probability that a grasp lifts, from the point's feature, the grasp, and what lies about the hand.

    Whether it lifts is decided where fingertips meet the object: each sees the points about it in its own frame.

    Labels say which points some known grasp touches; they do not say whether what the network tells there is any good.
    This is trained on exactly that: on the network's own grasps, closed on the true objects.

    Args:
        hand: whose grasps they are.
        channels: size of a point feature.
        choices: number of answers of the heads that it chooses from at each point.
        most: number of points, the most graspable as the heads think, whose grasps it looks at.
        hidden: widths of the hidden layers.
        around: widths of the layers on each point about the hand, whose maximum is then taken (PointNet).
        tips: widths of the layers on each point about a fingertip, whose maximum and mean are then taken; none: it does
            not look there.
        upright: what was done to the grasps whose outcome it has learnt, see `dexgrasp.selection.Selection`, rad.
        raised: likewise, m.
    """

    def __init__(
        self,
        hand: Hand,
        channels: int,
        choices: int = 3,
        most: int = 256,
        hidden: Sequence[int] = (256, 128),
        around: Sequence[int] = (32, 64),
        tips: Sequence[int] = (),
        upright: float = 0.0,
        raised: float = 0.0,
    ) -> None:
        super().__init__()
        self.hand, self.choices, self.most = hand, choices, most
        self.options: dict[str, Any] = {
            "choices": choices,
            "most": most,
            "hidden": list(hidden),
            "around": list(around),
            "tips": list(tips),
            "upright": upright,
            "raised": raised,
        }
        self.around = mlp(7, around[:-1], around[-1])
        self.tips = mlp(7, tips[:-1], tips[-1]) if tips else None
        self.tip = nn.Sequential(nn.Linear(2 * tips[-1], tips[-1]), nn.ReLU()) if tips else None
        self.spread = FINE if tips else COARSE
        """Number of `coarse_points` at which it looks."""
        felt = len(hand.fingers) * tips[-1] if tips else 0
        self.layers = mlp(channels + around[-1] + felt + 13 + len(hand.joint_names), hidden, 1)

    def look(
        self, grasps: Grasps, points: Float[Tensor, "Q 6"]
    ) -> tuple[Float[Tensor, "N K 7"], Float[Tensor, "N F T 7"]]:
        """Return what it sees about hands and fingertips of a scene's `coarse_points`, `self.spread` of them."""
        tips = at_tips(self.hand, grasps, points, AT_TIP if self.tips is not None else 0)
        return surroundings(self.hand, grasps, points[:COARSE]), tips

    def forward(
        self,
        features: Float[Tensor, "M C"],
        at: Float[Tensor, "N 6"],
        grasps: Grasps,
        around: Float[Tensor, "N K 7"],
        tips: Float[Tensor, "N F T 7"],
    ) -> Float[Tensor, "N"]:
        """Return N logits; `at` is point (m) and normal where each grasp is told, level frame; the rest is of `look`.

        Features of M points, of each of which N / M answers are judged: all points' first, all points' second, ...
        """
        offset = (grasps.pose[:, :3, 3] - at[:, :3]) / REACH
        turned = grasps.pose[:, :3, :2].flatten(1)
        near = torch.cat([piece.amax(dim=1) for piece in self._pieces(self.around, around.to(features))])
        seen = [near, offset, turned, at[:, 3:], at[:, 2:3] / REACH, grasps.joints]
        if self.tips is not None and self.tip is not None:
            pieces = self._pieces(self.tips, tips.to(features).flatten(0, 1))
            felt = torch.cat([torch.cat([piece.amax(dim=1), piece.mean(dim=1)], dim=1) for piece in pieces])
            seen.append(self.tip(felt).unflatten(0, (-1, tips.shape[1])).flatten(1))
        own = torch.cat([part.to(features) for part in seen], dim=1)
        return self.layers(features, own).squeeze(1)

    def _pieces(self, layers: Layers, rows: Float[Tensor, "N K 7"]) -> Iterator[Float[Tensor, "_ K D"]]:
        """Yield what layers make of the points about each of N places, piece by piece where that is quicker."""
        each, every = rows.shape[1], rows.flatten(0, 1)
        if self.training or torch.compiler.is_compiling() or rows.device.type != "cpu":
            pieces = iter([layers(every)])
        else:
            pieces = layers.in_pieces(every.split(max(PIECE * NEAREST // each, 1) * each))  # that stay in the cache
        return (piece.unflatten(0, (-1, each)) for piece in pieces)

    @torch.no_grad()
    def calibrate(self, logits: Float[Tensor, "N"], came: Float[Tensor, "N"]) -> None:
        """Make what is told come true (1 or 0) as often as it says, by `platt`; the order of grasps stays."""
        slope, shift = platt(logits, came)
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(slope)
        last.bias.mul_(slope).add_(shift)


def platt(logits: Float[Tensor, "N"], came: Float[Tensor, "N"]) -> tuple[float, float]:
    """Return slope (positive) and shift that turn logits into those of probabilities that come true (Platt 1999).

    Newton's method on the likelihood of slope * logit + shift, with one success and one failure more at a logit of 0
    so that it has an end where all come true.
    """
    x = torch.cat([logits.double(), logits.new_zeros(2).double()])
    y = torch.cat([came.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    design, found = torch.stack([x, torch.ones_like(x)], dim=1), torch.tensor([1.0, 0.0], dtype=torch.float64)
    for _ in range(50):
        told = (design @ found).sigmoid()
        curved = design.T @ (design * (told * (1 - told))[:, None]) + 1e-6 * torch.eye(2, dtype=torch.float64)
        step = torch.linalg.solve(curved, design.T @ (y - told))
        found = found + step.clamp(-1, 1)
        if step.abs().max() < 1e-9:
            break
    return max(float(found[0]), 1e-3), float(found[1])


def coarse_points(cloud: Float[Tensor, "N 6"], count: int = COARSE) -> Float[Tensor, "Q 6"]:
    """Return `count` points that are spread evenly over a cloud (farthest-point samples); more begin with fewer."""
    return cloud[farthest_points(cloud[:, :3], min(count, len(cloud)))]


def surroundings(hand: Hand, grasps: Grasps, points: Float[Tensor, "Q 6"]) -> Float[Tensor, "N K 7"]:
    """Return the `points` about each hand: position and normal in its palm's frame, height in the level one; scaled.

    The K nearest to the middle of its tips, in no particular order.
    """
    points = points.to(grasps.pose)
    middle = transform(grasps.pose, hand.fingertips(grasps.joints)[..., :3, 3].mean(dim=1).to(grasps.pose))
    palm = grasps.pose @ hand.base_T_palm.to(grasps.pose)
    return _seen(middle, palm, points, NEAREST, REACH)


def at_tips(hand: Hand, grasps: Grasps, points: Float[Tensor, "Q 6"], count: int = AT_TIP) -> Float[Tensor, "N F T 7"]:
    """Return the `count` points nearest to each fingertip's centre, in its frame (`Hand.fingertips`), scaled.

    Position, normal and height in the level frame, in no particular order.
    """
    tips = grasps.pose[:, None] @ hand.fingertips(grasps.joints).to(grasps.pose)
    if not count:
        return tips.new_zeros(*tips.shape[:2], 0, 7)
    every = tips.flatten(0, 1)
    return _seen(every[:, :3, 3], every, points.to(tips), count, TIP_REACH).unflatten(0, tips.shape[:2])


def _seen(
    middle: Float[Tensor, "N 3"], frame: Float[Tensor, "N 4 4"], points: Float[Tensor, "Q 6"], count: int, reach: float
) -> Float[Tensor, "N K 7"]:
    count = min(count, len(points))
    compiled = frame.device.type == "cpu" and frame.dtype == torch.float32 and not torch.compiler.is_compiling()
    quick = compiled and not frame.requires_grad
    return (_compiled if quick else around_reference)(middle, frame, points, count, reach)


def around_reference(
    middle: Float[Tensor, "N 3"],
    frame: Float[Tensor, "N 4 4"],
    points: Float[Tensor, "Q 6"],
    count: int,
    reach: float = REACH,
) -> Float[Tensor, "N K 7"]:
    """Return the `count` points nearest to each `middle`, in a frame of each and over `reach` (m), in plain torch."""
    apart = middle[:, None] - points[:, :3]
    nearest = apart.square().sum(dim=-1).topk(count, largest=False).indices
    positions, normals = points[nearest].split(3, dim=-1)
    local = (positions - frame[:, None, :3, 3]) @ frame[:, :3, :3] / reach
    return torch.cat([local, normals @ frame[:, :3, :3], positions[..., 2:] / reach], dim=-1)


def _compiled(
    middle: Float[Tensor, "N 3"], frame: Float[Tensor, "N 4 4"], points: Float[Tensor, "Q 6"], count: int, reach: float
) -> Float[Tensor, "N K 7"]:
    out = torch.empty(len(middle), count, 7)
    one, other, third = (part.detach().contiguous().numpy() for part in (middle, frame, points))
    _around(one, other, third, np.float32(1 / reach), out.numpy())
    return out


@njit(cache=True)
def _around(middle: np.ndarray, frame: np.ndarray, points: np.ndarray, scale: np.float32, out: np.ndarray) -> None:
    count, total = out.shape[1], len(points)
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    apart, last = np.empty(total, np.float32), np.float32(1e-3)
    zero, half, top = np.float32(0), np.float32(0.5), np.float32(np.inf)
    for i in range(len(middle)):
        a, b, c = middle[i]
        for k in range(total):
            u, v, w = x[k] - a, y[k] - b, z[k] - c
            apart[k] = u * u + v * v + w * w
        # The limit within which `count` lie. Counting is quick, and a few guesses are enough: that of the place before,
        # then as if points lay on a plane, and the middle where that does not lead on.
        below, limit, inside, guess, turns = np.float32(-1), top, total, last, 0
        while inside != count:
            if not (below < guess < limit):
                guess = half * (max(below, zero) + limit)
                if not (below < guess < limit):
                    break  # neighbouring numbers: several points lie at the very limit
            found = 0
            for k in range(total):
                found += apart[k] <= guess
            if found < count:
                below = guess
            else:
                limit, inside = guess, found
            turns += 1
            if limit == top:
                guess = np.float32(4) * guess
            elif turns < 8:
                guess = limit * np.float32(count + 0.5) / np.float32(inside + 0.5)
            else:
                guess = half * (max(below, zero) + limit)
        last = limit if zero < limit < top else last
        room = count  # for points at the very limit: as many as nearer ones leave
        for k in range(total):
            room -= apart[k] < limit
        r, n = frame[i], 0
        for start in range(0, total, BLOCK):
            stop, some = min(start + BLOCK, total), 0
            for k in range(start, stop):
                some += apart[k] <= limit
            if some == 0:
                continue
            for k in range(start, stop):
                if not apart[k] <= limit or (apart[k] == limit and room == 0) or n == count:
                    continue
                room -= apart[k] == limit
                u, v, w = x[k] - r[0, 3], y[k] - r[1, 3], z[k] - r[2, 3]
                p, q, s = points[k, 3], points[k, 4], points[k, 5]
                for axis in range(3):
                    out[i, n, axis] = (u * r[0, axis] + v * r[1, axis] + w * r[2, axis]) * scale
                    out[i, n, 3 + axis] = p * r[0, axis] + q * r[1, axis] + s * r[2, axis]
                out[i, n, 6] = z[k] * scale
                n += 1
        out[i, n:] = np.nan  # of a place that is none
