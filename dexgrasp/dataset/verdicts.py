"""Grasps verified by physics: which of an object's grasps lift it off the table, and how well metrics foretell it."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.collision import HandShape
from dexgrasp.dataset.clutter import Approach, feasible
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.store import digest
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps, Outcomes, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import Protocol, load_protocol
from dexgrasp.statistics import roc_area, roc_curve, wilson
from dexgrasp.wrench_model import WrenchModel

UNTESTED = -1
"""In place of a `Reason` where a grasp was not tested."""
KEEP = ("lifted", "tested", "all")
METRIC = "metric_"
"""Prefix of the names of metrics in a store."""
SHARE, POSES = 0.95, 8
"""Resting poses that together are this likely, and at most so many, are those in which grasps are tested."""


@dataclass(frozen=True)
class VerifySettings:
    """Which grasps are tested, how, and which of them scenes are made of."""

    protocol: str | Mapping[str, Any] = "lift-bulk-v1"
    """A name in conf/protocol, or all values of one."""
    per_object: int | None = 200
    """Grasps of an object that are tested, drawn at random; None: all."""
    keep: str = "lifted"
    """Scenes take grasps that were `lifted`, `tested`, or `all`."""

    def __post_init__(self) -> None:
        count = self.per_object
        if self.keep not in KEEP or not (count is None or (type(count) is int and count > 0)):
            expected = f"verify.keep one of {', '.join(KEEP)}, verify.per_object a whole number above 0 or null"
            raise DexgraspError(expected, f"{self.keep!r}, {count!r}", "set them so")
        _ = self.rules

    @cached_property
    def rules(self) -> Protocol:
        """The protocol; raises DexgraspError where there is none of that name."""
        return load_protocol(self.protocol).on_table("lift tests")

    @property
    def identity(self) -> dict[str, str]:
        """What a store says of the protocol that gave its verdicts."""
        return signature(self.rules)


@dataclass(frozen=True)
class Verdicts:
    """What became of the tested grasps of one object."""

    grasp: Int[Tensor, "T"]
    """Which grasps were tested, as rows of the object's."""
    reason: Int[Tensor, "T"]
    """`Reason` of each: 0 where it lifted."""
    height: Float[Tensor, "T"]
    """How far the object had risen at the end, m."""
    resting: Int[Tensor, "T"]
    """In which of `poses` the object stood."""
    poses: Float[Tensor, "K 4 4"]
    """world_T_object at rest, the table's surface at z = 0, m."""

    def tensors(self) -> dict[str, Tensor]:
        """Return everything, small."""
        kinds = {"grasp": torch.int32, "reason": torch.int8, "height": torch.float32, "resting": torch.int8}
        return {name: value.to(kinds.get(name, torch.float64)) for name, value in vars(self).items()}


def signature(protocol: Protocol) -> dict[str, str]:
    """Return what a store says of the protocol that gave its verdicts: name with version, hash of all settings."""
    return {"protocol": str(protocol), "protocol_hash": digest(protocol.values())}


def tally(reasons: Int[Tensor, "T"]) -> dict[str, Any]:
    """Return how many were tested, how many lifted, and how often each reason came."""
    names = Counter(Reason(int(reason)).name.lower() for reason in reasons)
    return {"tested": len(reasons), "lifted": names["success"], "reasons": dict(names)}


def verify(
    hand: Hand,
    shape: HandShape,
    item: Object,
    grasps: Grasps,
    settings: VerifySettings,
    approach: Approach,
    rng: np.random.Generator,
) -> Verdicts:
    """Try grasps of an object (its frame) where it stands alone on the table at rest.

    A grasp is tried in one resting pose, drawn as likely as the object comes to rest so among those in which the
    hand stays clear of the table; one that has none is left untested. Physics has settled the object before.
    """
    protocol = settings.rules
    simulator = MujocoSimulator(protocol)
    poses, likely = at_rest(item, simulator)
    rows = torch.from_numpy(rng.permutation(len(grasps)))
    ways = torch.zeros(len(grasps), len(poses), dtype=torch.bool)
    for column, pose in enumerate(poses):
        world = grasps[rows].to(torch.float64).moved(pose)
        ways[:, column] = feasible(shape, hand, world, pose[None], [], approach)
    able = ways.any(dim=1)
    rows, ways = rows[able][: settings.per_object], ways[able][: settings.per_object]
    chances = (ways * likely).cumsum(dim=1)
    draws = torch.from_numpy(rng.uniform(size=len(rows)))[:, None] * chances[:, -1:] if len(poses) else chances
    resting = (draws >= chances).sum(dim=1).clamp(max=max(len(poses) - 1, 0))
    reason, height = torch.full((len(rows),), UNTESTED), torch.zeros(len(rows), dtype=torch.float64)
    for number, pose in enumerate(poses):
        which = (resting == number).nonzero().flatten()
        world = grasps[rows[which]].to(torch.float64).moved(pose)
        outcomes = simulator.execute([item], pose[None], hand, world, protocol)
        reason[which], height[which] = outcomes.reason, outcomes.height
    return Verdicts(rows, reason, height, resting, poses)


def verify_scene(
    hand: Hand,
    objects: Sequence[Object],
    poses: Float[Tensor, "O 4 4"],
    grasps: Grasps,
    protocol: Protocol,
    fixtures: Boxes,
) -> Outcomes:
    """Try grasps (world frame) in the scene itself: each has to lift the object that it belongs to, and no other."""
    simulator = MujocoSimulator(protocol)
    return simulator.execute(objects, poses, hand, grasps, protocol, grasps.object, fixtures)


def at_rest(item: Object, simulator: MujocoSimulator) -> tuple[Float[Tensor, "K 4 4"], Float[Tensor, "K"]]:
    """Return the likeliest poses world_T_object in which an object rests in physics, and how likely each is."""
    poses, likelihood = item.stable
    order = np.argsort(-likelihood, kind="stable")[:POSES]
    order = order[: int(np.searchsorted(likelihood[order].cumsum(), SHARE * likelihood.sum())) + 1]
    settled = [simulator.settle([item], torch.from_numpy(poses[k]).double()[None], 0) for k in order]
    found = torch.cat(settled)
    still = found.flatten(1).isfinite().all(dim=1)
    return found[still], torch.from_numpy(likelihood[order].copy())[still]


def metrics(grasps: Grasps, model: WrenchModel) -> dict[str, Float[Tensor, "N"]]:
    """Return what is known of grasps (object frame) without physics; of all of them more should be better.

    `epsilon` and `volume` are of the L1 hull, `epsilon_linf` of the L-infinity hull (METHOD section 5); `spread` is
    the contacts' mean distance from their centroid, `centred` minus the centroid's from the centre of mass, both m
    (NaN where no finger touches). All are of the contacts of the fingers that touch; `model` has the centre of mass
    as its origin.
    """
    contacts, normals = grasps.contacts.double(), grasps.normals.double()
    middle = contacts.nanmean(dim=1)
    offset = torch.linalg.vector_norm(middle - torch.tensor(model.origin, dtype=torch.float64), dim=1)
    spread = torch.linalg.vector_norm(contacts - middle[:, None], dim=-1).nanmean(dim=1)
    return {
        "epsilon": torch.as_tensor(model.epsilon(contacts, normals).values),
        "epsilon_linf": torch.as_tensor(replace(model, hull="linf").epsilon(contacts, normals).values),
        "volume": torch.as_tensor(model.volume(contacts, normals).values),
        "spread": spread,
        "centred": -offset,
    }


@dataclass(frozen=True)
class Agreement:
    """How well a metric tells grasps that lift from those that do not: areas under ROC curves."""

    pooled: float | None
    """Over all tested grasps; None where all end alike."""
    within: float | None
    """Mean over objects of which some grasps lift and some do not, weighted by the number of tests."""
    curve: tuple[np.ndarray, np.ndarray]
    """Shares of those that do not lift and of those that do, from the best score down."""


def agreement(store: Iterable[Item]) -> tuple[dict[str, Agreement], Bool[Tensor, "T"]]:
    """Return the agreement of each metric with the verdicts of a store, and which of its tested grasps lifted."""
    items = [item.tensors for item in store]
    lifted = [item["reason"] == int(Reason.SUCCESS) for item in items]
    together = torch.cat(lifted) if lifted else torch.zeros(0, dtype=torch.bool)
    found = {}
    for name in [name for name in sorted(items[0] if items else ()) if name.startswith(METRIC)]:
        scores = torch.cat([item[name] for item in items])
        areas = [(roc_area(item[name], good), len(good)) for item, good in zip(items, lifted, strict=True)]
        told = [(area, count) for area, count in areas if area is not None]
        within = sum(area * count for area, count in told) / sum(count for _, count in told) if told else None
        found[name.removeprefix(METRIC)] = Agreement(roc_area(scores, together), within, roc_curve(scores, together))
    return found, together


def summary(store: Iterable[Item], protocol: str) -> list[str]:
    """Return the verdicts of a store in a few lines of text."""
    found, lifted = agreement(store)
    low, high = wilson(int(lifted.sum()), len(lifted))
    share = f"{int(lifted.sum())} of {len(lifted)}, 95 % {low:.1%} .. {high:.1%}"
    lines = [f"lifted by {protocol}: {lifted.double().mean():.1%} ({share})" if len(lifted) else "nothing was tested"]
    if found and any(each.pooled is not None for each in found.values()):
        lines.append("area under the ROC as a sign of lifting: pooled, within objects")
        texts = {name: [_told(each.pooled), _told(each.within)] for name, each in found.items()}
        lines += [f"  {name:14}{pooled:>7}{within:>7}" for name, (pooled, within) in texts.items()]
    return lines


def _told(area: float | None) -> str:
    return "-" if area is None else f"{area:.3f}"
