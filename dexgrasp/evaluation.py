"""Closed-loop evaluation: look, predict, choose, execute, remove, look again (METHOD section 5)."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.execution import tilted
from dexgrasp.geometry import inverse, rotation_angle
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.planner import Situation
from dexgrasp.scene import Boxes, View
from dexgrasp.seeds import stream
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.simulator import Simulator
from dexgrasp.statistics import bootstrap_ratio, rate_interval

Look = Callable[[Sequence[Object], Float[Tensor, "O 4 4"], int], View]
"""Renders the objects at their poses; the last argument seeds camera and noise."""
Predict = Callable[[Situation], Grasps]
"""Returns grasps in the camera frame, best first."""
Epsilon = Callable[[Object, Float[Tensor, "4 4"], Grasps], float]
"""Returns the epsilon quality that one grasp (world frame) reaches on an object at a pose."""


@dataclass(frozen=True)
class Attempt:
    """One executed grasp, or the look at which none was found, which ends a scene."""

    scene: int
    number: int
    success: bool
    reason: str
    target: str | None
    """Object on which the predicted contact lies (ground truth, for the report only)."""
    lifted: str | None
    score: float | None
    epsilon: float | None
    seconds: dict[str, float]
    """Wall-clock time of render, predict, execute."""


@dataclass(frozen=True)
class Episode:
    """One scene worked on until it is empty or the attempts are used up."""

    scene: int
    present: tuple[str, ...]
    removed: tuple[str, ...]
    attempts: tuple[Attempt, ...]
    strips: tuple[dict[str, Any], ...] = field(default=(), repr=False)
    """What a report needs to draw each attempt: poses, the grasp and those offered beside it, view and its seed."""


@dataclass(frozen=True)
class Policy:
    """How many attempts there are, and which of the predicted grasps is executed."""

    attempts_per_object: float = 1.5
    min_lift: float = 0.5
    """Grasps that the network's scorer thinks less likely to lift are not tried; of no effect without a scorer."""
    distance: float = 0.03
    """A grasp within this distance (m) and angle of one that failed in this scene is not tried."""
    angle: float = 0.5
    """rad"""
    doubt: float = 0.6
    """What a grasp is worth after each failure near it, as a share: what has failed once is likely to fail again."""
    near: float = 0.08
    """m between contacts"""


def clear(
    index: int,
    objects: Sequence[Object],
    poses: Float[Tensor, "O 4 4"],
    hand: Hand,
    look: Look,
    predict: Predict,
    simulator: Simulator,
    protocol: Protocol,
    policy: Policy,
    seed: int,
    epsilon: Epsilon | None = None,
    draw: bool = False,
    fixtures: Boxes | None = None,
    least: float = 0.0,
) -> Episode:
    """Clear one scene, at most ``policy.attempts_per_object`` attempts per object.

    What is worth less than `least`, after doubts, is not tried.

    Objects that leave the table count as present and are never removed. Poses are world_T_object; the pose of an
    object that is gone is NaN. After a failure the scene settles before the camera looks again.
    """
    names = tuple(item.name for item in objects)
    poses = poses.clone()
    removed: list[str] = []
    attempts: list[Attempt] = []
    strips: list[dict[str, Any]] = []
    failed: list[Grasps] = []
    budget = math.floor(policy.attempts_per_object * len(objects))
    while len(attempts) < budget and len(standing := present(poses)) > protocol.verdict.stop_at:
        began = time.perf_counter()
        there, drawn = tuple(objects[i] for i in standing), _seed(seed, "look", index, len(attempts))
        view = look(there, poses[standing], drawn)
        looked = time.perf_counter()
        situation = Situation(view, there, poses[standing].double(), fixtures, drawn)
        offered = predict(situation).moved(view.world_T_camera)
        chosen = choose(offered[~tilted(hand, offered, protocol.verdict.max_tilt)], failed, policy, least)
        predicted = time.perf_counter()
        seconds = {"render": looked - began, "predict": predicted - looked}
        if chosen is None:
            # Another look from the same place shows the same: what is left stays, and that counts as a failure.
            attempts.append(Attempt(index, len(attempts), False, "no_grasp", None, None, None, None, seconds))
            break
        seen = _target(chosen, view)
        target = None if seen is None else standing[seen]
        outcome = simulator.execute(objects, poses, hand, chosen, protocol, fixtures=fixtures)
        seconds["execute"] = time.perf_counter() - predicted
        success, row = bool(outcome.success[0]), int(outcome.object[0])
        attempts.append(
            Attempt(
                scene=index,
                number=len(attempts),
                success=success,
                reason=Reason(int(outcome.reason[0])).name.lower(),
                target=None if target is None else names[target],
                lifted=names[row] if success else None,
                score=float(chosen.quality[0]),
                epsilon=None if epsilon is None or target is None else epsilon(objects[target], poses[target], chosen),
                seconds=seconds,
            )
        )
        if draw:
            told = {"names": names, "poses": poses.clone(), "grasp": chosen, "offered": offered}
            strips.append(told | {"view": view, "seed": drawn})
        after = outcome.final[0].to(poses)
        if success:
            removed.append(names[row])
            after[row] = math.nan
        failed += [] if success else [chosen]
        poses = simulator.settle(objects, after, _seed(seed, "settle", index, len(attempts)), fixtures).to(poses)
    return Episode(index, names, tuple(removed), tuple(attempts), tuple(strips))


def present(poses: Float[Tensor, "O 4 4"]) -> list[int]:
    """Return the indices of objects that are still there (pose not NaN)."""
    return [int(i) for i in poses.flatten(1).isfinite().all(dim=1).nonzero().flatten()]


def choose(offered: Grasps, failed: Sequence[Grasps], policy: Policy, least: float = 0.0) -> Grasps | None:
    """Return the offered grasp (world frame) worth most that does not repeat a failed one, None where there is none.

    What is near failures is worth less (`Policy.doubt`), and nothing worth less than `least` is chosen.
    """
    fresh, worth, places = torch.ones(len(offered), dtype=torch.bool), offered.quality.clone(), _place(offered)
    for grasp in failed:
        near = torch.linalg.vector_norm(offered.pose[:, :3, 3] - grasp.pose[:, :3, 3], dim=1) < policy.distance
        alike = rotation_angle(offered.pose[:, :3, :3], grasp.pose[:, :3, :3]) < policy.angle
        fresh &= ~(near & alike)
        doubtful = torch.linalg.vector_norm(places - _place(grasp), dim=1) < policy.near
        worth[doubtful] *= policy.doubt
    order = torch.argsort(worth, descending=True, stable=True)
    order = order[(fresh & (worth >= least))[order]]
    return offered[int(order[0])] if len(order) else None


def _place(grasps: Grasps) -> Float[Tensor, "N 3"]:
    """Return the mean of the contacts that are known, else where the base is."""
    known = ~grasps.contacts.isnan().any(dim=2, keepdim=True)
    mean = torch.where(known, grasps.contacts, 0.0).sum(dim=1) / known.sum(dim=1).clamp(min=1)
    return torch.where(known.any(dim=1), mean, grasps.pose[:, :3, 3])


def summarise(episodes: Sequence[Episode], seed: int) -> dict[str, Any]:
    """Return SR, CR and epsilon with 95 % intervals (`statistics.rate_interval` over scenes)."""
    wins = [sum(a.success for a in e.attempts) for e in episodes]
    tries = [len(e.attempts) for e in episodes]
    removed, present = [len(e.removed) for e in episodes], [len(e.present) for e in episodes]
    (interval, kind), (cleared, _) = rate_interval(wins, tries, seed), rate_interval(removed, present, seed)
    attempts = [attempt for episode in episodes for attempt in episode.attempts]
    qualities = [[a.epsilon for a in e.attempts if a.epsilon is not None] for e in episodes]
    return {
        "scenes": len(episodes),
        "attempts": sum(tries),
        "objects": sum(present),
        "success_rate": {**rate(sum(wins), sum(tries), interval), "interval_kind": kind},
        "completion_rate": rate(sum(removed), sum(present), cleared),
        "epsilon": rate(
            float(sum(map(sum, qualities))),
            sum(map(len, qualities)),
            bootstrap_ratio([float(sum(q)) for q in qualities], [len(q) for q in qualities], seed),
        ),
        "reasons": dict(Counter(attempt.reason for attempt in attempts)),
        "seconds": {
            stage: float(np.median(times))
            if (times := [a.seconds[stage] for a in attempts if stage in a.seconds])
            else None
            for stage in ("render", "predict", "execute")
        },
    }


def rate(top: float, bottom: int, interval: tuple[float, float]) -> dict[str, Any]:
    """Return a rate with what it was made of; None where nothing was tried."""
    return {"value": top / bottom if bottom else None, "low": interval[0], "high": interval[1], "trials": bottom}


def attempt_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Return every attempt as plain values, for results.json."""
    return [asdict(attempt) for episode in episodes for attempt in episode.attempts]


def episode_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Return of every scene which objects were there and which were removed, for results.json."""
    return [{"scene": e.scene, "present": e.present, "removed": e.removed} for e in episodes]


def _target(grasp: Grasps, view: View) -> int | None:
    """Return the object nearest to the grasp's known contact, or None for the table."""
    contacts = grasp.moved(inverse(view.world_T_camera.to(grasp.pose))).contacts[0]
    known = contacts[~contacts.isnan().any(dim=1)]
    if len(known) == 0:
        return None
    nearest = torch.cdist(known[:1], view.points.to(known), compute_mode="donot_use_mm_for_euclid_dist").argmin()
    instance = int(view.instance[nearest])
    return instance if instance >= 0 else None


def _seed(seed: int, *keys: str | int) -> int:
    return int(stream(seed, *keys).integers(2**31))
