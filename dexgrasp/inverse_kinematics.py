"""Joint vectors that bring an arm's flange to given poses: damped least squares, many goals and seeds at once."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.arm import Arm
from dexgrasp.seeds import torch_stream

LENGTH = 0.3
"""An error of so many metres counts as much as one of 1 rad."""
PLACE, TURN = 1e-4, 1e-3
"""A goal is reached within these, m and rad."""
DAMPING = 1e-6
"""Least damping; the error is added to it."""
LONGEST = 0.6
"""Largest step of a joint, rad or m."""


def descend(
    arm: Arm, goals: Float[Tensor, "N 4 4"], starts: Float[Tensor, "N A"], steps: int = 50
) -> tuple[Float[Tensor, "N A"], Bool[Tensor, "N"]]:
    """Return joints within limits that lead from `starts` to base_T_flange `goals`, and whether they reach them.

    Levenberg-Marquardt, damped by the error itself (Sugihara 2011, "Solvability-unconcerned inverse kinematics by the
    Levenberg-Marquardt method"). A joint that stands at its limit and would go on is left out of a step. Rows that
    have arrived drop out.
    """
    low, high = arm.limits.T
    joints = starts.clamp(low, high)
    good = torch.zeros(len(goals), dtype=torch.bool)
    active = torch.arange(len(goals))
    eye = torch.eye(len(low), dtype=torch.float64)
    weight = torch.tensor([1 / LENGTH] * 3 + [1.0] * 3, dtype=torch.float64)
    for step in range(steps + 1):
        now = joints[active]
        pose, jacobian = arm.jacobian(now)
        goal = goals[active]
        place = goal[:, :3, 3] - pose[:, :3, 3]
        turn = rotation_vector(goal[:, :3, :3] @ pose[:, :3, :3].transpose(1, 2))
        there = (place.norm(dim=1) < PLACE) & (turn.norm(dim=1) < TURN)
        good[active[there]] = True
        if step == steps or bool(there.all()):
            break
        left = ~there
        active, now = active[left], now[left]
        error = (torch.cat([place, turn], dim=1) * weight)[left]
        slope = jacobian[left] * weight[:, None]
        pull = (slope.transpose(1, 2) @ error.unsqueeze(2)).squeeze(2)
        stuck = ((now <= low) & (pull < 0)) | ((now >= high) & (pull > 0))
        slope = slope.masked_fill(stuck.unsqueeze(1), 0.0)
        damping = (0.5 * error.square().sum(1) + DAMPING)[:, None, None] * eye
        pull = pull.masked_fill(stuck, 0.0)
        move = torch.linalg.solve(slope.transpose(1, 2) @ slope + damping, pull)
        move = move * (LONGEST / move.abs().amax(dim=1, keepdim=True).clamp(min=LONGEST))
        joints[active] = (now + move).clamp(low, high)
    return joints, good


def solutions(
    arm: Arm, goals: Float[Tensor, "N 4 4"], seeds: int = 8, rounds: int = 4, seed: int = 0
) -> tuple[Float[Tensor, "N K A"], Bool[Tensor, "N K"]]:
    """Return up to K = seeds solutions of each goal, nearest to the arm's home posture first, and which are ones.

    The first seed is the home posture, others are drawn within limits (by `seed`). Goals without any solution are
    tried again from new seeds, in `rounds` at most; goals beyond the arm's reach are not tried.
    """
    low, high = arm.limits.T
    joints = arm.home.repeat(len(goals), seeds, 1)
    good = torch.zeros(len(goals), seeds, dtype=torch.bool)
    rows = (goals[:, :3, 3].norm(dim=1) <= arm.reach).nonzero().flatten()
    for number in range(rounds):
        if len(rows) == 0:
            break
        draw = torch_stream(seed, "inverse kinematics", number)
        starts = low + (high - low) * torch.rand(seeds, len(low), generator=draw, dtype=torch.float64)
        if number == 0:
            starts[0] = arm.home
        every = starts.repeat(len(rows), 1)
        found, reached = descend(arm, goals[rows].repeat_interleave(seeds, dim=0), every)
        joints[rows], good[rows] = found.view(len(rows), seeds, -1), reached.view(len(rows), seeds)
        rows = rows[~good[rows].any(dim=1)]
    away = (joints - arm.home).abs().sum(dim=2).masked_fill(~good, torch.inf)
    order = away.argsort(dim=1, stable=True)
    return joints.gather(1, order.unsqueeze(2).expand_as(joints)), good.gather(1, order)


def rotation_vector(rotation: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3"]:
    """Return axis times angle (rad) of each rotation; 0, too, at half a turn, where the axis has no sign."""
    skew = torch.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        dim=1,
    )
    sine = skew.norm(dim=1, keepdim=True)
    cosine = (rotation.diagonal(dim1=1, dim2=2).sum(dim=1, keepdim=True) - 1) / 2
    angle = torch.atan2(sine / 2, cosine)
    return skew * torch.where(sine > 1e-9, angle / sine.clamp(min=1e-9), torch.full_like(sine, 0.5))
