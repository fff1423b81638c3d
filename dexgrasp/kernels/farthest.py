"""Farthest point sampling on a GPU, exactly: few passes over the cloud instead of one for each point.

One pass for each point, as usual, reads the whole cloud `count` times, one after the other. But the next points are
known from few candidates: let T be a distance, and C all points whose distance to the chosen ones exceeds T. Distances
only ever fall, so that as long as one in C exceeds T the farthest of all is in C, and it, its ties and whatever it
does to the other candidates are found there. With T such that C is about a thousand points, which fit in the registers
of one block, a few dozen passes over the cloud choose thousands of points.
"""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

CANDIDATES = 1024
"""At most so many; a round is good when it has half of them."""
BLOCK = 2048
"""Points that a block looks at together."""
WIDE = 4096
"""Clouds of more points than that are updated by many blocks, if they are few,"""
FEW = 16
"""as many or less,"""
ROUNDS = 24
"""for so many rounds, about what 20,000 points seen by a camera take for 2,048. Whatever is left is done by one block
for each cloud, however long it takes: the host need not know."""


def farthest(axes: Float[Tensor, "B 3 N"], count: int) -> Int[Tensor, "B count"]:
    """Return the places (int32) of `count` points of each cloud in order; see `Arranged`."""
    batch, _, total = axes.shape
    device = axes.device
    nearest = torch.full((batch, total), float("inf"), device=device)
    chosen = torch.empty(batch, count, dtype=torch.int32, device=device)
    told = torch.empty(batch, 2, dtype=torch.int32, device=device)
    share = torch.empty(batch, device=device)
    kept = torch.empty(batch, 4, CANDIDATES, device=device)
    rows = torch.empty(batch, CANDIDATES, dtype=torch.int32, device=device)
    # Without fused multiply-add, so that distances are the CPU's bit by bit.
    exact = {"enable_fp_fusion": False}
    _first[(batch,)](axes, chosen, told, share, total, count, BLOCK=BLOCK, num_warps=8, **exact)
    work = (axes, nearest, chosen, told, share, kept, rows, total, count)
    sizes = {"BLOCK": BLOCK, "CANDIDATES": CANDIDATES, "num_warps": 8}
    if total > WIDE and batch <= FEW:
        for _ in range(ROUNDS):
            _approach[(triton.cdiv(total, 512), batch)](
                axes, nearest, chosen, told, total, count, BLOCK=512, num_warps=4, **exact
            )
            _choose[(batch,)](*work, ONCE=True, **sizes, **exact)
    _choose[(batch,)](*work, ONCE=False, **sizes, **exact)
    return chosen


@triton.jit
def _first(axes, chosen, told, share, total, count, BLOCK: tl.constexpr):
    """Choose the point farthest from the middle of the bounding box."""
    cloud = tl.program_id(0).to(tl.int64)
    axes += cloud * total * 3
    lanes = tl.arange(0, BLOCK)
    low_x = tl.full((BLOCK,), float("inf"), tl.float32)
    low_y = low_x
    low_z = low_x
    high_x = -low_x
    high_y = -low_x
    high_z = -low_x
    for start in range(0, total, BLOCK):
        at = tl.minimum(start + lanes, total - 1)
        x = tl.load(axes + at)
        y = tl.load(axes + total + at)
        z = tl.load(axes + 2 * total + at)
        low_x, high_x = tl.minimum(low_x, x), tl.maximum(high_x, x)
        low_y, high_y = tl.minimum(low_y, y), tl.maximum(high_y, y)
        low_z, high_z = tl.minimum(low_z, z), tl.maximum(high_z, z)
    x0 = (tl.min(low_x, axis=0) + tl.max(high_x, axis=0)) * 0.5
    y0 = (tl.min(low_y, axis=0) + tl.max(high_y, axis=0)) * 0.5
    z0 = (tl.min(low_z, axis=0) + tl.max(high_z, axis=0)) * 0.5
    most = tl.full((BLOCK,), -1.0, tl.float32)
    where = tl.zeros((BLOCK,), tl.int32)
    for start in range(0, total, BLOCK):
        at = tl.minimum(start + lanes, total - 1)
        dx = tl.load(axes + at) - x0
        dy = tl.load(axes + total + at) - y0
        dz = tl.load(axes + 2 * total + at) - z0
        apart = dx * dx + dy * dy + dz * dz
        where = tl.where(apart > most, at, where)
        most = tl.maximum(apart, most)
    reach = tl.max(most, axis=0)
    tl.store(chosen + cloud * count, tl.min(tl.where(most == reach, where, total - 1), axis=0))
    tl.store(told + cloud * 2, 0)
    tl.store(told + cloud * 2 + 1, 1)
    tl.store(share + cloud, 0.9)


@triton.jit
def _lower(axes, nearest, chosen, first, last, start, total, BLOCK: tl.constexpr):
    """Lower the distances of a run of points to those that the points chosen first..last leave."""
    at = start + tl.arange(0, BLOCK)
    real = at < total
    x = tl.load(axes + at, mask=real, other=0.0)
    y = tl.load(axes + total + at, mask=real, other=0.0)
    z = tl.load(axes + 2 * total + at, mask=real, other=0.0)
    distance = tl.load(nearest + at, mask=real, other=0.0)
    for one in range(first, last):
        row = tl.load(chosen + one)
        dx = x - tl.load(axes + row)
        dy = y - tl.load(axes + total + row)
        dz = z - tl.load(axes + 2 * total + row)
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
    tl.store(nearest + at, distance, mask=real)


@triton.jit
def _approach(axes, nearest, chosen, told, total, count, BLOCK: tl.constexpr):
    """Lower the distances of one run of points of one cloud."""
    cloud = tl.program_id(1).to(tl.int64)
    first = tl.load(told + cloud * 2)
    last = tl.load(told + cloud * 2 + 1)
    if first < last:
        start = tl.program_id(0) * BLOCK
        axes += cloud * total * 3
        _lower(axes, nearest + cloud * total, chosen + cloud * count, first, last, start, total, BLOCK)


@triton.jit
def _choose(
    axes,
    nearest,
    chosen,
    told,
    share,
    kept,
    rows,
    total,
    count,
    BLOCK: tl.constexpr,
    CANDIDATES: tl.constexpr,
    ONCE: tl.constexpr,
):
    """Choose points of one cloud: one round, its distances being lowered already, or all rounds that are left."""
    cloud = tl.program_id(0).to(tl.int64)
    axes += cloud * total * 3
    nearest += cloud * total
    chosen += cloud * count
    kept += cloud * CANDIDATES * 4
    rows += cloud * CANDIDATES
    told += cloud * 2
    first = tl.load(told)
    last = tl.load(told + 1)
    part = tl.load(share + cloud)
    if ONCE:
        done = last
        if last < count:
            done, part = _round(axes, nearest, chosen, kept, rows, last, part, total, count, BLOCK, CANDIDATES)
        tl.store(told, last)
        tl.store(told + 1, done)
        tl.store(share + cloud, part)
    else:
        while last < count:
            for start in range(0, total, BLOCK):
                _lower(axes, nearest, chosen, first, last, start, total, BLOCK)
            tl.debug_barrier()  # what one thread has written is read by others
            first = last
            last, part = _round(axes, nearest, chosen, kept, rows, last, part, total, count, BLOCK, CANDIDATES)


@triton.jit
def _round(axes, nearest, chosen, kept, rows, last, part, total, count, BLOCK: tl.constexpr, CANDIDATES: tl.constexpr):
    """Choose from a set of candidates; return how many are chosen and which part of the reach has bounded the set."""
    lanes = tl.arange(0, BLOCK)
    most = tl.full((BLOCK,), -1.0, tl.float32)
    where = tl.zeros((BLOCK,), tl.int32)
    for start in range(0, total, BLOCK):
        at = tl.minimum(start + lanes, total - 1)
        distance = tl.load(nearest + at)
        where = tl.where(distance > most, at, where)
        most = tl.maximum(distance, most)
    reach = tl.max(most, axis=0)
    farthest = tl.min(tl.where(most == reach, where, total - 1), axis=0)

    limit = reach  # beyond which lie the candidates
    low = reach * 0.0
    high = reach
    guess = reach * part
    tries = 0
    if total <= CANDIDATES:
        limit = reach * 0.0 - 1.0
        tries = 8
    while tries < 8:
        beyond = tl.zeros((BLOCK,), tl.int32)
        for start in range(0, total, BLOCK):
            at = start + lanes
            distance = tl.load(nearest + at, mask=at < total, other=-1.0)
            beyond += (distance > guess).to(tl.int32)
        found = tl.sum(beyond, axis=0)
        tries += 1
        if found > CANDIDATES:
            low = guess
        else:
            limit = guess
            high = guess
            if found * 2 >= CANDIDATES:
                tries = 8
        guess = (low + high) * 0.5

    count_kept = 0
    for start in range(0, total, BLOCK):
        at = start + lanes
        distance = tl.load(nearest + at, mask=at < total, other=-1.0)
        take = (at < total) & (distance > limit)
        place = count_kept + tl.cumsum(take.to(tl.int32), axis=0) - 1
        tl.store(rows + place, at, mask=take)
        tl.store(kept + place, tl.load(axes + at, mask=take), mask=take)
        tl.store(kept + CANDIDATES + place, tl.load(axes + total + at, mask=take), mask=take)
        tl.store(kept + 2 * CANDIDATES + place, tl.load(axes + 2 * total + at, mask=take), mask=take)
        tl.store(kept + 3 * CANDIDATES + place, distance, mask=take)
        count_kept += tl.sum(take.to(tl.int32), axis=0)
    tl.debug_barrier()  # what one thread has written is read by others

    if count_kept == 0:  # more equals than candidates, a lattice's: one by one; and where all are chosen, the first
        stop = last + 1
        if reach == 0.0:
            stop = count
        for one in range(last, stop):
            tl.store(chosen + one, farthest)
        last = stop
    else:
        place = tl.arange(0, CANDIDATES)
        real = place < count_kept
        x = tl.load(kept + place, mask=real, other=0.0)
        y = tl.load(kept + CANDIDATES + place, mask=real, other=0.0)
        z = tl.load(kept + 2 * CANDIDATES + place, mask=real, other=0.0)
        distance = tl.load(kept + 3 * CANDIDATES + place, mask=real, other=-2.0)
        best, slot = tl.max(distance, axis=0, return_indices=True)
        while (best > limit) & (last < count):
            row = tl.load(rows + slot)
            dx = x - tl.load(kept + slot)
            dy = y - tl.load(kept + CANDIDATES + slot)
            dz = z - tl.load(kept + 2 * CANDIDATES + slot)
            distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
            tl.store(chosen + last, row)
            last += 1
            best, slot = tl.max(distance, axis=0, return_indices=True)
    tl.debug_barrier()
    part = limit / tl.maximum(reach, 1e-30)
    if part <= 0.0 or part >= 1.0:
        part = part * 0.0 + 0.9
    return last, part
