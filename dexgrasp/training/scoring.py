"""Teaching the scorer: the network's own grasps on the training's views, judged on the true objects."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import joblib
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.batch import Batch
from dexgrasp.child import start_worker
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.stages import scene_truth
from dexgrasp.dataset.verdicts import verify_scene
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.level import levelled
from dexgrasp.model import GraspNet, load_model
from dexgrasp.progress import track
from dexgrasp.reliability import reliability
from dexgrasp.scene import View
from dexgrasp.scorer import COARSE, Scorer, coarse_points, surroundings
from dexgrasp.seeds import stream, torch_stream
from dexgrasp.selection import free
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.statistics import roc_area

DRAWN = 3
"""So many times the grasps wanted of a view are drawn: most meet what the camera sees."""
SPREAD = 2048
"""Points of a view of which none may lie in the open hand: fewer than in prediction, to save time."""


@dataclass(frozen=True)
class ScorerSettings:
    """`conf/scorer`; see there for what each value does."""

    choices: int = 3
    most: int = 640
    hidden: tuple[int, ...] = (256, 128)
    around: tuple[int, ...] = (32, 64)
    per_view: int = 200
    verdicts: int = 0
    protocol: str = "lift-bulk-v1"
    weight: float = 5.0
    views: int | None = None
    epochs: int = 4
    batch: int = 2048
    learning_rate: float = 0.004
    weight_decay: float = 0.01
    capacity: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 5.0)
    clear: tuple[float, ...] = (0.24, 0.26, 0.41, 0.78, 0.86, 0.91, 0.95)
    blocked: tuple[float, ...] = (0.21, 0.27, 0.40, 0.63, 0.71, 0.72, 0.77)

    def __post_init__(self) -> None:
        for name in ("choices", "most", "per_view", "epochs", "batch"):
            if getattr(self, name) < 1:
                raise DexgraspError(f"scorer.{name} of at least 1", str(getattr(self, name)), f"set scorer.{name}")
        if self.verdicts < 0 or self.weight <= 0:
            found = f"{self.verdicts}, {self.weight}"
            raise DexgraspError("scorer.verdicts of at least 0, scorer.weight above it", found, "set them so")
        load_protocol(self.protocol).on_table("the scorer's verdicts")
        for name in ("clear", "blocked"):
            worth, wanted = getattr(self, name), len(self.capacity) + 2
            if len(worth) != wanted or not all(0 <= value <= 1 for value in worth):
                raise DexgraspError(f"scorer.{name}: {wanted} shares in 0..1", str(worth), f"set scorer.{name}")
        if list(self.capacity) != sorted(self.capacity):
            raise DexgraspError("scorer.capacity in ascending order", str(self.capacity), "set scorer.capacity")


@dataclass(frozen=True)
class Proposals(Batch):
    """Grasps that a network proposed, where it did, and what became of them."""

    features: Float[Tensor, "N C"]
    at: Float[Tensor, "N 6"]
    """Point (m) and normal, level frame."""
    pose: Float[Tensor, "N 4 4"]
    """level_T_base, m."""
    joints: Float[Tensor, "N J"]
    around: Float[Tensor, "N K 7"]
    """What lies about the hand, see `dexgrasp.scorer.surroundings`; half precision."""
    score: Float[Tensor, "N"]
    """Probability of graspable as the heads tell it."""
    worth: Float[Tensor, "N"]
    """How likely the grasp is to lift, by how it closes on the true object."""
    lifted: Float[Tensor, "N"]
    """What the simulator says: 1 lifted, 0 not, NaN not tried."""
    holds: Bool[Tensor, "N"]
    """It is clear of everything and holds so many times its weight as labels do, its own at least."""


@dataclass(frozen=True)
class ScorerSummary:
    """What the scorer saw and what it is worth on views that it did not see."""

    proposals: int
    holding: float
    """Share of the proposals that hold."""
    seconds: float
    area: float | None = None
    """Area under the ROC on validation views."""
    area_before: float | None = None
    """The same of the heads' own score."""
    verdicts: dict[str, Any] | None = None
    """Reliability (`dexgrasp.reliability`) on what was executed of validation views, before it was calibrated there."""


def fit_scorer(
    model: GraspNet, path: Path, dataset: Dataset, settings: ScorerSettings, seed: int, workers: int
) -> ScorerSummary:
    """Give `model` (on the CPU, as it lies at `path`) a scorer taught on the dataset's training views.

    The result does not depend on the number of workers.
    """
    began = time.perf_counter()
    known = _propose(path, dataset, dataset.split("train")[: settings.views], settings, seed, workers, "scorer")
    if not len(known):  # nothing to learn from: the heads' own score stays
        return ScorerSummary(0, 0.0, time.perf_counter() - began)
    torch.manual_seed(int(stream(seed, "scorer").integers(2**31)))
    scorer = Scorer(
        model.hand, known.features.shape[1], settings.choices, settings.most, settings.hidden, settings.around
    )
    _fit(scorer, known, settings, seed)
    model.scorer = scorer
    area = before = verdicts = None
    if dataset.split("validation"):
        unseen = _propose(path, dataset, dataset.split("validation"), settings, seed, workers, "scorer, validation")
        with torch.no_grad():
            told = scorer(unseen.features, unseen.at, _grasps(unseen), unseen.around)
        area, before = roc_area(told, unseen.holds), roc_area(unseen.score, unseen.holds)
        tried = ~unseen.lifted.isnan()
        if tried.any():
            verdicts = reliability(told[tried].sigmoid(), unseen.lifted[tried] > 0)
            scorer.calibrate(told[tried], unseen.lifted[tried])
    holding, seconds = float(known.holds.double().mean()), time.perf_counter() - began
    return ScorerSummary(len(known), holding, seconds, area, before, verdicts)


def _fit(scorer: Scorer, known: Proposals, settings: ScorerSettings, seed: int) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums that are cut up otherwise end in other bits
    scorer.train()
    optimizer = torch.optim.AdamW(scorer.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    size = min(settings.batch, len(known))
    steps = settings.epochs * (len(known) // size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, settings.learning_rate, total_steps=steps + 1)
    order = torch_stream(seed, "scorer order")
    for _ in range(settings.epochs):
        shuffled = torch.randperm(len(known), generator=order)
        for start in range(0, len(known) - size + 1, size):
            rows = known[shuffled[start : start + size]]
            logits = scorer(rows.features, rows.at, _grasps(rows), rows.around)
            tried = ~rows.lifted.isnan()
            wanted = torch.where(tried, rows.lifted, rows.worth)
            weight = torch.where(tried, settings.weight, 1.0)
            loss = F.binary_cross_entropy_with_logits(logits, wanted, weight)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    scorer.eval()
    torch.set_num_threads(threads)


def _grasps(known: Proposals) -> Grasps:
    return Grasps.build(known.pose, known.joints, 1)


def _propose(
    path: Path, dataset: Dataset, views: Sequence[int], settings: ScorerSettings, seed: int, workers: int, label: str
) -> Proposals:
    parallel = joblib.Parallel(n_jobs=workers, return_as="generator", initializer=start_worker)
    stamp = path.stat().st_mtime_ns
    jobs = (joblib.delayed(_of_view)(path, stamp, dataset, view, settings, seed) for view in views)
    return Proposals.cat(list(track(parallel(jobs), label, total=len(views))))


@torch.no_grad()
def _of_view(path: Path, stamp: int, dataset: Dataset, index: int, settings: ScorerSettings, seed: int) -> Proposals:
    """Return some of the grasps told in one view, judged; the worker's only entry."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        model, hand = _network(path, stamp), dataset.hand
        view = levelled(dataset.view(index))
        cloud = torch.cat([view.points, view.normals], dim=1)
        features, seeds, told = model.told(cloud, choices=settings.choices, most=settings.most)
        grasps = Grasps.cat(told).replace(object=view.instance[seeds].repeat(len(told)))
        # On objects, where it is hard to tell; a few elsewhere, so that the table is known not to be graspable.
        order = torch.from_numpy(stream(seed, "proposals", index).permutation(len(grasps)))
        on = grasps.object[order] >= 0
        rows = torch.cat([order[on][: DRAWN * settings.per_view], order[~on][: settings.per_view // 10]])
        # What prediction rules out by itself teaches nothing.
        coarse, table = coarse_points(cloud, SPREAD), torch.eye(4, dtype=torch.float64)
        passed = free(hand, dataset.shape, grasps[rows], coarse[:, :3], table, model.selection)
        rows = rows[passed][: settings.per_view]
        grasps, at = grasps[rows], rows % len(seeds)
        truth = scene_truth(dataset, dataset.scene_of(index), view.world_T_camera.double())
        found = truth.outcome(grasps)
        # 0: one finger or none; else by how many times its weight the object is held.
        kind = 1 + torch.bucketize(found.capacity, torch.tensor(settings.capacity).to(found.capacity), right=True)
        kind[found.touched < 2] = 0
        worth = torch.where(found.clear, torch.tensor(settings.clear)[kind], torch.tensor(settings.blocked)[kind])
        holds = found.clear & (found.capacity >= max(truth.settings.capacity, 1.0))
        around = surroundings(hand, grasps, coarse[:COARSE]).half()
        lifted = torch.full_like(worth, torch.nan)
        lifted[: settings.verdicts] = _executed(dataset, view, grasps[: settings.verdicts], index, settings.protocol)
        told_by = features[at], cloud[seeds[at]], grasps.pose, grasps.joints, around, grasps.quality
        return Proposals(*told_by, worth, lifted, holds)
    finally:
        torch.set_num_threads(threads)


def _executed(dataset: Dataset, view: View, grasps: Grasps, index: int, protocol: str) -> Float[Tensor, "N"]:
    """Return 1 for each grasp (level frame) that the simulator lifts on the untouched scene, else 0."""
    if not len(grasps):
        return torch.zeros(0)
    scene = dataset.scene(dataset.scene_of(index))
    objects = [dataset.objects[name] for name in scene.objects]
    # Whatever it lifts counts, as in an evaluation, not only the object at which it was told.
    placed = grasps.to(torch.float64).moved(view.world_T_camera.double())
    placed = placed.replace(object=torch.full_like(placed.object, -1))
    tried = verify_scene(dataset.hand, objects, scene.poses.double(), placed, load_protocol(protocol), scene.fixtures)
    return tried.success.float()


@lru_cache(1)
def _network(path: Path, stamp: int) -> GraspNet:
    """`stamp` tells a file from an older one of that name."""
    return load_model(path)
