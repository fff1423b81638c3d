"""Simulated annealing of a palm's pose and the amplitudes of eigengrasps, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from dexgrasp.borrow import borrowed
from dexgrasp.collision import deepest
from dexgrasp.distance import Field
from dexgrasp.hand_body import HandBody, carry, place_links
from dexgrasp_eigengrasp.energy import Wanted, state_energy

TRIES = 11
"""Neighbours that are drawn before a step is given up, all of them in collision."""
APART, TURN = 0.01, 0.3
"""Of states nearer to each other than these, m and rad, the best is kept."""


class Schedule(NamedTuple):
    """Ingber's: temperature t0 exp(-c k^(1/d)) at step k, for acceptance and for neighbours alike."""

    start: float
    cooling: float
    dimensions: float
    first: float
    """Step at which a chain begins,"""
    last: float
    """and ends; between them its steps are spread evenly."""
    energy: float
    """Energies are multiplied by it before they are compared at a temperature."""


class Space(NamedTuple):
    """What is searched: palm poses in the object's frame, and postures start + amplitudes x axes, from 0 to 1."""

    palm_T_base: np.ndarray
    """(3, 4)."""
    start: np.ndarray
    """(J,)."""
    axes: np.ndarray
    """(K, J)."""
    centre: np.ndarray
    """(3,), m."""
    half: float
    """The palm stays in a cube of twice this about it, m."""
    jumps: np.ndarray
    """(3,) largest jump of a coordinate, m, of a rotation, rad, of an amplitude."""
    planes: np.ndarray
    """(P, 4) normal . x >= offset is free, object frame: the table."""
    overlap: float
    """Deepest overlap with the object that is no collision, m."""


@njit(cache=True)
def temperature(schedule: Schedule, step: float) -> float:
    """Return the temperature at a step."""
    return schedule.start * math.exp(-schedule.cooling * step ** (1.0 / schedule.dimensions))


@njit(cache=True)
def neighbour(temperature: float, unit: float) -> float:
    """Return a jump in -1..1 from a number in 0..1, uniform: the less, the colder (Ingber 1989)."""
    far = abs(2.0 * unit - 1.0)
    jump = temperature * ((1.0 + 1.0 / temperature) ** far - 1.0)
    return -jump if unit < 0.5 else jump


@njit(cache=True, error_model="numpy")
def _below(body: HandBody, planes: np.ndarray, poses: np.ndarray, stack: np.ndarray) -> bool:
    """Return whether any ball of the hand is under a plane."""
    for p in range(len(planes)):
        a, b, c, offset = planes[p]
        for link in range(len(body.roots)):
            if body.roots[link] < 0:
                continue
            stack[0], top = body.roots[link], 1
            while top:
                top -= 1
                node = stack[top]
                x, y, z = carry(poses, link, body.balls, node)
                if a * x + b * y + c * z - offset >= body.balls[node, 3]:
                    continue
                if body.children[node, 0] < 0:
                    return True
                stack[top], stack[top + 1] = body.children[node, 0], body.children[node, 1]
                top += 2
    return False


@njit(cache=True, error_model="numpy")
def _place(
    body: HandBody,
    space: Space,
    palm: np.ndarray,
    amplitudes: np.ndarray,
    base: np.ndarray,
    joints: np.ndarray,
    full: np.ndarray,
    poses: np.ndarray,
) -> None:
    for i in range(3):
        for j in range(4):
            base[i, j] = palm[i, 3] if j == 3 else 0.0
            for k in range(3):
                base[i, j] += palm[i, k] * space.palm_T_base[k, j]
    for j in range(len(joints)):
        value = space.start[j]
        for k in range(len(amplitudes)):
            value += amplitudes[k] * space.axes[k, j]
        joints[j] = min(max(value, body.joint_limits[j, 0]), body.joint_limits[j, 1])
    place_links(body, joints, base, full, poses)


@njit(cache=True)
def anneal(
    body: HandBody,
    field: Field,
    wanted: Wanted,
    space: Space,
    schedule: Schedule,
    palms: np.ndarray,
    amplitudes: np.ndarray,
    steps: int,
    keep: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Anneal one chain that starts at the first legal of some states; return its best ones.

    `palms` (S, 3, 4) object_T_palm and `amplitudes` (S, K) are the states to start from. Returns object_T_base
    (B, 3, 4), joints (B, J) and energies (B,), best first, at most `keep`; none where no start is legal.
    """
    joints_count, axes_count = len(space.start), len(space.axes)
    base, joints, full = np.empty((3, 4)), np.empty(joints_count), np.empty(len(body.offset))
    poses, stack = np.empty((len(body.parents), 3, 4)), np.empty(256, np.int64)
    best, best_base, best_joints = np.full(keep, np.inf), np.zeros((keep, 3, 4)), np.zeros((keep, joints_count))
    _anneal(
        body, field, wanted, space, schedule, palms, amplitudes, steps, rng, (best, best_base, best_joints),
        (base, joints, full, poses, np.empty((3, 4)), np.empty((3, 4)), np.empty(axes_count), np.empty(axes_count)),
        (np.empty(7), np.empty((len(wanted.links) + 1, 4)), np.empty(1)), stack,
    )  # fmt: skip
    order = np.argsort(best)
    order = order[best[order] < np.inf]
    return best_base[order], best_joints[order], best[order]


@njit(cache=True, error_model="numpy")
def _anneal(
    body: HandBody,
    field: Field,
    wanted: Wanted,
    space: Space,
    schedule: Schedule,
    palms: np.ndarray,
    amplitudes: np.ndarray,
    steps: int,
    rng: np.random.Generator,
    results: tuple[np.ndarray, np.ndarray, np.ndarray],
    state: tuple[np.ndarray, ...],
    scratch: tuple[np.ndarray, np.ndarray, np.ndarray],
    stack: np.ndarray,
) -> None:
    body, field, wanted, space = borrowed(body), borrowed(field), borrowed(wanted), borrowed(space)
    palms, amplitudes, stack = borrowed(palms), borrowed(amplitudes), borrowed(stack)
    best, best_base, best_joints = results
    base, joints, full, poses, palm, palm_n, posture, posture_n = state
    hit, weighed, alone = scratch
    energy = np.inf
    for s in range(len(palms)):
        palm[:], posture[:] = palms[s], amplitudes[s]
        _place(body, space, palm, posture, base, joints, full, poses)
        if not _below(body, space.planes, poses, stack) and not _inside(body, field, poses, space.overlap):
            energy = state_energy(wanted, field, poses, hit, weighed, alone)
            _keep(energy, base, joints, best, best_base, best_joints)
            break
    if energy == np.inf:
        return
    for step in range(steps):
        warm = temperature(schedule, schedule.first + (schedule.last - schedule.first) * step / steps)
        legal = False
        for _ in range(TRIES):
            _jump(space, warm, rng, palm, palm_n, posture, posture_n)
            _place(body, space, palm_n, posture_n, base, joints, full, poses)
            legal = not _below(body, space.planes, poses, stack) and not _inside(body, field, poses, space.overlap)
            if legal:
                break
        if not legal:
            continue
        new = state_energy(wanted, field, poses, hit, weighed, alone)
        if new < energy or rng.random() < math.exp(schedule.energy * (energy - new) / warm):
            palm[:], posture[:], energy = palm_n, posture_n, new
            _keep(energy, base, joints, best, best_base, best_joints)


@njit(cache=True)
def _inside(body: HandBody, field: Field, poses: np.ndarray, overlap: float) -> bool:
    return deepest(body, field, poses, -overlap, True) < -overlap


@njit(cache=True, error_model="numpy")
def _jump(
    space: Space,
    warm: float,
    rng: np.random.Generator,
    palm: np.ndarray,
    palm_n: np.ndarray,
    posture: np.ndarray,
    posture_n: np.ndarray,
) -> None:
    """Draw a neighbour; what would leave the space is drawn anew."""
    for k in range(3):
        while True:
            palm_n[k, 3] = palm[k, 3] + space.jumps[0] * neighbour(warm, rng.random())
            if abs(palm_n[k, 3] - space.centre[k]) <= space.half:
                break
    for k in range(len(posture)):
        while True:
            posture_n[k] = posture[k] + space.jumps[2] * neighbour(warm, rng.random())
            if 0.0 <= posture_n[k] <= 1.0:
                break
    x = space.jumps[1] * neighbour(warm, rng.random())
    y = space.jumps[1] * neighbour(warm, rng.random())
    z = space.jumps[1] * neighbour(warm, rng.random())
    angle = math.sqrt(x * x + y * y + z * z)
    s = math.sin(angle) / angle if angle > 1e-12 else 1.0
    v = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    for i in range(3):  # about the palm's own axes (Rodrigues, from the right)
        a, b, c = palm[i, 0], palm[i, 1], palm[i, 2]
        along = a * x + b * y + c * z
        square = x * x + y * y + z * z
        palm_n[i, 0] = a + s * (b * z - c * y) + v * (along * x - square * a)
        palm_n[i, 1] = b + s * (c * x - a * z) + v * (along * y - square * b)
        palm_n[i, 2] = c + s * (a * y - b * x) + v * (along * z - square * c)


@njit(cache=True, error_model="numpy")
def _keep(
    energy: float,
    base: np.ndarray,
    joints: np.ndarray,
    best: np.ndarray,
    best_base: np.ndarray,
    best_joints: np.ndarray,
) -> None:
    """Put a state in place of one like it that is worse, or else of the worst of all."""
    worst = 0
    for b in range(len(best)):
        if best[b] > best[worst]:
            worst = b
    if energy >= best[worst]:
        return
    place = worst
    for b in range(len(best)):
        if best[b] == np.inf:
            continue
        square, trace = 0.0, 0.0
        for i in range(3):
            square += (base[i, 3] - best_base[b, i, 3]) ** 2
            for j in range(3):
                trace += base[i, j] * best_base[b, i, j]
        if square < APART * APART and trace > 1.0 + 2.0 * math.cos(TURN):
            if energy >= best[b]:
                return
            place = b
            break
    best[place], best_base[place], best_joints[place] = energy, base, joints
