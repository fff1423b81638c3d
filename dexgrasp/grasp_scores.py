"""One set of grasps, judged under any number of protocols and told with metrics that need no physics."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import joblib
import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from dexgrasp.child import in_workers
from dexgrasp.collision import HandShape
from dexgrasp.dataset.clutter import Approach
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.verdicts import METRIC, UNTESTED, VerifySettings, agreement, verify
from dexgrasp.distance import DistanceField
from dexgrasp.evaluation import rate
from dexgrasp.grasp_metrics import LESS_IS_BETTER, closed, diversity, grasp_metrics
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.progress import track
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.statistics import rate_interval
from dexgrasp.threads import one_thread

FLOATING = 1.0
"""Objects of protocols without a table float this high above it, m."""


@dataclass(frozen=True)
class Judged:
    """What became of the grasps of one object under one protocol."""

    reasons: Int[Tensor, "N"]
    """`Reason` of each; -1 where it was not tried: the table or the protocol's tilt is in the way."""
    seconds: float
    """Processor time."""


@dataclass(frozen=True)
class Scored:
    """Everything about the grasps of one object."""

    item: Object
    judged: dict[str, Judged]
    metrics: dict[str, Tensor] = field(default_factory=dict)
    grasps: Grasps | None = None
    """With their contacts."""


def judge(hand: Hand, shape: HandShape, item: Object, grasps: Grasps, protocol: Protocol, seed: int) -> Judged:
    """Try every grasp (object frame) by the rules of `protocol`; the same seed gives the same verdicts.

    On a table the object stands alone in a resting pose, drawn among those in which the hand is clear of the table
    (`dataset.verdicts.verify`); floating, its frame's axes are the world's.
    """
    began = time.process_time()
    reasons = torch.full((len(grasps),), UNTESTED)
    if not len(grasps):
        return Judged(reasons, 0.0)
    if protocol.disturbance is None:
        settings = VerifySettings(protocol.values(), None)
        found = verify(hand, shape, item, grasps, settings, Approach(), stream(seed, "score", item.name))
        reasons[found.grasp] = found.reason
        reasons[reasons == int(Reason.NO_GRASP)] = UNTESTED
    else:
        placed = torch.eye(4, dtype=torch.float64)
        placed[2, 3] = FLOATING
        world = grasps.to(torch.float64).moved(placed)
        reasons = MujocoSimulator(protocol).execute([item], placed[None], hand, world, protocol).reason
    return Judged(reasons, time.process_time() - began)


@dataclass(frozen=True)
class Scoring:
    """What is scored, and how; sent to worker processes."""

    hand: Hand
    protocols: tuple[Protocol, ...]
    seed: int
    metrics: bool = True

    def run(self, bodies: Sequence[tuple[Object, Grasps]], workers: int) -> list[Scored]:
        """Score the grasps of each object; the result does not depend on the number of workers."""
        jobs = (joblib.delayed(_work)(self, item, grasps) for item, grasps in bodies)
        return list(track(in_workers(jobs, workers), "scoring", total=len(bodies)))

    def score(self, item: Object, grasps: Grasps) -> Scored:
        """Score the grasps (object frame) of one object."""
        shape = HandShape(self.hand)
        judged = {each.name: judge(self.hand, shape, item, grasps, each, self.seed) for each in self.protocols}
        if not self.metrics or not len(grasps):
            return Scored(item, judged)
        surface = DistanceField.build(item.mesh)
        told = closed(self.hand, surface, grasps)
        physics = self.protocols[0].physics
        return Scored(item, judged, grasp_metrics(self.hand, shape, item, surface, told, physics), told)


@one_thread()
def _work(scoring: Scoring, item: Object, grasps: Grasps) -> Scored:
    return scoring.score(item, grasps)


def summary(scored: Sequence[Scored], protocol: Protocol, seed: int) -> dict[str, Any]:
    """Return SR under one protocol with its 95 % interval (`statistics.rate_interval` over objects)."""
    reasons = [each.judged[protocol.name].reasons for each in scored]
    tried = [each[each != UNTESTED] for each in reasons]
    wins, tries = [int((each == int(Reason.SUCCESS)).sum()) for each in tried], [len(each) for each in tried]
    interval, kind = rate_interval(wins, tries, seed)
    numbers, counts = torch.cat([*tried, torch.zeros(0, dtype=torch.long)]).unique(return_counts=True)
    told = {Reason(int(n)).name.lower(): int(count) for n, count in zip(numbers, counts, strict=True)}
    spent = sum(each.judged[protocol.name].seconds for each in scored)
    return {
        "protocol": str(protocol),
        "protocol_values": protocol.values(),
        "grasps": sum(map(len, reasons)),
        "objects": len(reasons),
        "success_rate": {**rate(sum(wins), sum(tries), interval), "interval_kind": kind},
        "reasons": told,
        "seconds_per_grasp": spent / max(sum(tries), 1),
    }


def metric_table(scored: Sequence[Scored], protocols: Sequence[Protocol]) -> dict[str, dict[str, Any]]:
    """Return mean and median of each metric, and the area under its ROC against success under each protocol.

    `areas`: per protocol, over all tried grasps and within objects (0.5: says nothing; None: all ended alike).
    """
    names = sorted({name for each in scored for name in each.metrics})
    areas: dict[str, dict[str, dict[str, float | None]]] = {name: {} for name in names}
    for protocol in protocols:
        found, _ = agreement(_items(scored, protocol))
        for name, each in found.items():
            areas[name][protocol.name] = {"all": each.pooled, "within": each.within}
    table = {}
    for name in names:
        values = torch.cat([each.metrics[name] for each in scored if each.metrics])
        known = values[values.isfinite()]
        table[name] = {
            "mean": float(known.mean()) if len(known) else None,
            "median": float(known.median()) if len(known) else None,
            "known": len(known),
            "areas": areas[name],
        }
    return table


def _items(scored: Sequence[Scored], protocol: Protocol) -> list[Item]:
    """Return verdicts and metrics as a store of verdicts has them, of all metrics more being better."""
    items = []
    for each in scored:
        reasons = each.judged[protocol.name].reasons
        tried = reasons != UNTESTED
        if not each.metrics or not tried.any():
            continue
        signed = {name: -value if name in LESS_IS_BETTER else value for name, value in each.metrics.items()}
        tensors = {METRIC + name: torch.nan_to_num(value[tried], nan=-np.inf) for name, value in signed.items()}
        items.append(Item(each.item.name, {"reason": reasons[tried], **tensors}, {}))
    return items


def variety(scored: Sequence[Scored], hand: Hand, seed: int) -> dict[str, float]:
    """Return the diversity of the set, see `grasp_metrics.diversity`."""
    told = [each for each in scored if each.grasps is not None]
    return diversity(hand, ((each.item, DistanceField.build(each.item.mesh), each.grasps) for each in told), seed)  # type: ignore[misc]


def text(results: Mapping[str, Any]) -> str:
    """Return the table for the terminal: a row a protocol, then metrics with their areas under the ROC."""
    lines = [f"{results['title']}: {results['grasps']} grasps of {results['hand']}, seed {results['seed']}"]
    lines += [f"  {'protocol':28}{'SR %  [95 %]':>22}{'tried':>8}{'s each':>9}  outcomes"]
    for row in results["protocols"]:
        entry = row["success_rate"]
        value = "-" if entry["value"] is None else f"{100 * entry['value']:.1f}"
        shown = f"{value} [{100 * entry['low']:.1f}, {100 * entry['high']:.1f}]"
        reasons = ", ".join(f"{name} {count}" for name, count in sorted(row["reasons"].items(), key=lambda r: -r[1]))
        lines.append(f"  {row['protocol']:28}{shown:>22}{entry['trials']:8d}{row['seconds_per_grasp']:9.3f}  {reasons}")
    if results["metrics"]:
        names = [row["protocol_values"]["name"] for row in results["protocols"]]
        lines += [f"  {'metric':20}{'mean':>12}{'median':>12}  area under the ROC, all / within objects"]
        lines += [f"  {'':44}  " + "".join(f"{name:>18}" for name in names)]
        for name, entry in results["metrics"].items():
            told = "".join(f"{_area(entry['areas'].get(each)):>18}" for each in names)
            lines.append(f"  {name:20}{_number(entry['mean']):>12}{_number(entry['median']):>12}  {told}")
    lines += [f"  {name:28}{value:.3f}" for name, value in results["diversity"].items()]
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _area(areas: Mapping[str, float | None] | None) -> str:
    if not areas:
        return "-"
    return " / ".join("-" if areas[key] is None else f"{areas[key]:.2f}" for key in ("all", "within"))
