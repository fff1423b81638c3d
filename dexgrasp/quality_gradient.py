"""Epsilon for those who optimise: exact with its gradient, or bounded from above in pure torch on any device.

epsilon = min over unit u of h(u), h(u) = max_i w_i . u: every direction bounds it from above, and is below 0 where
the hull does not hold the origin, so that the bounds pull a grasp towards closure where epsilon itself is flat.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.quality import nearest_facet

SHARPNESS = (20.0, 3000.0)
"""Of the maximum that directions descend on, from the first step to the last: log-sum-exp times 1 / sharpness."""
MOMENTUM = 0.8


def differentiable_epsilon(wrenches: Float[Tensor, "N W 6"]) -> Float[Tensor, "N"]:
    """Return exact epsilon (L1 hull) with its gradient; where it is 0, minus how far one direction shows no closure.

    Where epsilon > 0 the nearest facet tells both: with its foot point's weights l, sum_i l_i w_i = epsilon n, the
    gradient is l_i n (envelope theorem). It exists where that facet is the only one, if what varies keeps its corners
    on one plane: contacts, normals and friction do; single wrenches of a cone may not. Elsewhere the value is h(u) <= 0
    along a direction that proves it; 0 without gradient for sets of fewer than six dimensions. The hull is found on
    the CPU, the rest stays on the tensor's device. First derivatives only.
    """
    radius, normal, names = (torch.from_numpy(part).to(wrenches.device) for part in nearest_facet(wrenches))
    value = _support(wrenches, normal.to(wrenches)[:, None]).squeeze(1)
    inside = radius > 0
    if not inside.any():
        return value
    rows, normal, radius = wrenches[inside], normal[inside], radius[inside]
    facet = torch.take_along_dim(rows, names[inside, :, None], dim=1)
    with torch.no_grad():
        # Weights of the facet's corners at the foot point; least squares, for corners of one cone may be dependent.
        system = torch.cat([facet.double().transpose(1, 2), torch.ones_like(facet[:, :1]).double()], dim=1)
        foot = torch.cat([radius[:, None] * normal, torch.ones_like(radius[:, None])], dim=1)
        weights = (torch.linalg.pinv(system) @ foot[..., None]).squeeze(-1).to(wrenches)
    along = (facet * normal.to(wrenches)[:, None]).sum(dim=-1)
    exact = (weights * along).sum(dim=-1)
    return value.masked_scatter(inside, exact + (radius.to(wrenches) - exact).detach())


def epsilon_bound(
    wrenches: Float[Tensor, "N W 6"], directions: Float[Tensor, "*N D 6"], contacts: int = 0
) -> Float[Tensor, "N"]:
    """Return the least support min_u h(u) over unit directions, one list for all sets or one each: epsilon <= it.

    Differentiable with respect to the wrenches at fixed directions, batched, on any device. With contacts > 0 the
    hull is L-infinity (see `quality.epsilon`). How loose: docs/quality.md.
    """
    return _support(wrenches, directions.to(wrenches), contacts).amin(dim=-1)


def support_directions(
    wrenches: Float[Tensor, "N W 6"], count: int = 8, steps: int = 60, spread: int = 256, seed: int = 0
) -> Float[Tensor, "N D 6"]:
    """Return `count` unit directions per set in which its L1 hull reaches least: the `directions` of a tight bound.

    The best of `spread` fixed ones (points on the sphere, antipodal, drawn by `seed`) descend on a maximum that is
    smooth at first and sharp at last. No gradient flows through them.
    """
    if not 0 < count <= spread:
        raise DexgraspError("0 < count <= spread", f"{count=}, {spread=}", "start from more directions")
    with torch.no_grad():
        half = torch.randn((spread + 1) // 2, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        fixed = torch.nn.functional.normalize(torch.cat([half, -half])[:spread], dim=-1).to(wrenches)
        best = _support(wrenches, fixed).topk(count, dim=-1, largest=False).indices
        u = fixed[best]
        least, kept, pace = _support(wrenches, u), u, torch.zeros_like(u)
        for step in range(steps):
            share = step / max(steps - 1, 1)
            sharpness = SHARPNESS[0] * math.exp(share * math.log(SHARPNESS[1] / SHARPNESS[0]))
            weights = torch.softmax(sharpness * (u @ wrenches.transpose(1, 2)), dim=-1)
            pull = weights @ wrenches
            pace = MOMENTUM * pace - pull / sharpness**0.75
            pace = pace - (pace * u).sum(dim=-1, keepdim=True) * u
            u = torch.nn.functional.normalize(u + pace, dim=-1)
            reach = _support(wrenches, u)
            kept = torch.where((reach < least)[..., None], u, kept)
            least = torch.minimum(least, reach)
        return kept


def _support(
    wrenches: Float[Tensor, "N W 6"], directions: Float[Tensor, "*N D 6"], contacts: int = 0
) -> Float[Tensor, "N D"]:
    values = directions @ wrenches.transpose(1, 2)
    if not contacts:
        return values.amax(dim=-1)
    return values.unflatten(-1, (contacts, -1)).amax(dim=-1).clamp(min=0).sum(dim=-1)
