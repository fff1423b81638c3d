"""The nearest points within a ball on a GPU: one warp for each centre, runs of points out of reach are skipped."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

BLOCK = 256
"""Points that a warp looks at together."""


def nearest(
    axes: Float[Tensor, "B 3 N"],
    order: Int[Tensor, "B N"],
    centres: Float[Tensor, "B M 3"],
    count: int,
    radius: float = float("inf"),
) -> Int[Tensor, "B M count"]:
    """Return the rows (int64) of the nearest `count` points within `radius` (m) of each centre; see `Arranged`.

    Nearest first; equal distances are decided by x, then y, then z. Where there are fewer, the nearest is repeated
    (also when it lies outside).
    """
    batch, _, total = axes.shape
    centres = centres.detach().float().contiguous()
    many = centres.shape[1]
    out = torch.empty(batch, many, count, dtype=torch.int64, device=centres.device)
    slots = triton.next_power_of_2(count)
    # As float64, which a kernel's own arguments are not.
    reach = torch.full((1,), radius, dtype=torch.float64, device=centres.device)
    _nearest[(many, batch)](
        axes,
        order,
        centres,
        reach,
        out,
        total,
        many,
        COUNT=count,
        SLOTS=slots,
        BLOCK=BLOCK,
        num_warps=1,
        enable_fp_fusion=False,  # distances are then the CPU's bit by bit
    )
    return out


@triton.jit
def _nearest(
    axes,
    order,
    centres,
    reach,
    out,
    total,
    many,
    COUNT: tl.constexpr,
    SLOTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    cloud = tl.program_id(1).to(tl.int64)
    axes += cloud * total * 3
    order += cloud * total
    centre = cloud * many + tl.program_id(0)
    # Float64, as the CPU's tree: points differ by millimetres around a metre.
    x0 = tl.load(centres + centre * 3).to(tl.float64)
    y0 = tl.load(centres + centre * 3 + 1).to(tl.float64)
    z0 = tl.load(centres + centre * 3 + 2).to(tl.float64)
    radius = tl.load(reach)
    square = radius * radius
    lanes = tl.arange(0, BLOCK)
    slots = tl.arange(0, SLOTS)
    used = slots < COUNT
    distance = tl.full((SLOTS,), float("inf"), tl.float64)
    row = total + slots  # unlike each other, so that one at a time is exchanged
    limit = square
    for start in range(0, total, BLOCK):
        gap = _gap(axes, x0, start, total, BLOCK)
        if gap * gap < limit:
            apart = _apart(axes, x0, y0, z0, start + lanes, total)
            least, lane = tl.min(apart, axis=0, return_indices=True)
            while least < limit:  # of equals, the first rows came first and stay
                worst = tl.max(tl.where(used, distance, -1.0), axis=0)
                last = tl.max(tl.where(used & (distance == worst), row, -1), axis=0)
                gone = used & (row == last)
                distance = tl.where(gone, least, distance)
                row = tl.where(gone, start + lane, row)
                limit = tl.minimum(square, tl.max(tl.where(used, distance, -1.0), axis=0))
                apart = tl.where(lanes == lane, float("inf"), apart)
                least, lane = tl.min(apart, axis=0, return_indices=True)

    shortest = tl.min(tl.where(used, distance, float("inf")), axis=0)
    first = tl.min(tl.where(used & (distance == shortest), row, 2147483647), axis=0)
    if first >= total:  # nobody within the radius: the nearest of all
        low = tl.full((BLOCK,), float("inf"), tl.float64)
        where = tl.zeros((BLOCK,), tl.int32)
        for start in range(0, total, BLOCK):
            apart = _apart(axes, x0, y0, z0, start + lanes, total)
            where = tl.where(apart < low, start + lanes, where)
            low = tl.minimum(apart, low)
        shortest = tl.min(low, axis=0)
        first = tl.min(tl.where(low == shortest, where, total), axis=0)

    far = tl.where(used, distance, float("inf"))
    nearer = far[None, :] < far[:, None]
    nearer = nearer | ((far[None, :] == far[:, None]) & (row[None, :] < row[:, None]))
    place = tl.sum(nearer.to(tl.int32), axis=1)
    found = tl.load(order + tl.where(row < total, row, first))
    tl.store(out + centre * COUNT + place, found.to(tl.int64), mask=place < COUNT)


@triton.jit
def _gap(axes, x0, start, total, BLOCK: tl.constexpr):
    """Return how far the centre is from the planes of x between which a run of points lies."""
    low = tl.load(axes + start).to(tl.float64)
    high = tl.load(axes + tl.minimum(start + BLOCK, total) - 1).to(tl.float64)
    return tl.maximum(tl.maximum(low - x0, x0 - high), 0.0)


@triton.jit
def _apart(axes, x0, y0, z0, at, total):
    """Return squared distances, infinite beyond the last point."""
    real = at < total
    dx = tl.load(axes + at, mask=real, other=0.0).to(tl.float64) - x0
    dy = tl.load(axes + total + at, mask=real, other=0.0).to(tl.float64) - y0
    dz = tl.load(axes + 2 * total + at, mask=real, other=0.0).to(tl.float64) - z0
    return tl.where(real, dx * dx + dy * dy + dz * dz, float("inf"))
