"""Grasps that a network proposes in a dataset's views, judged on the true objects and in part tried in physics."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import joblib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.batch import Batch
from dexgrasp.child import in_workers
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.stages import scene_truth
from dexgrasp.dataset.verdicts import verify_scene
from dexgrasp.grasps import Grasps
from dexgrasp.level import levelled
from dexgrasp.model import GraspNet, load_model
from dexgrasp.progress import track
from dexgrasp.scene import View
from dexgrasp.seeds import stream
from dexgrasp.selection import free, on_table, select
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.surroundings import FINE, coarse_points, look
from dexgrasp.threads import one_thread
from dexgrasp.training.scorer_settings import ScorerSettings
from dexgrasp.training.surrogate import facts

DRAWN = 3
"""So many times the grasps wanted of a view are drawn: most meet what the camera sees."""
SPREAD = FINE
"""Points of a view of which none may lie in the open hand: fewer than in prediction, to save time."""
LEVEL = torch.eye(4, dtype=torch.float64)
"""The table in the level frame."""


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
    """What lies about the hand, see `dexgrasp.surroundings.surroundings`; half precision."""
    swept: Float[Tensor, "N F S 7"]
    """What is nearest to its fingers on their way, see `dexgrasp.surroundings.swept`; half precision."""
    score: Float[Tensor, "N"]
    """Probability of graspable as the heads tell it."""
    facts: Float[Tensor, "N K"]
    """How it closes on the true object, see `dexgrasp.training.surrogate.facts`."""
    worth: Float[Tensor, "N"]
    """How likely the grasp is to lift, by what it then holds (`ScorerSettings.capacity`)."""
    lifted: Float[Tensor, "N"]
    """What the simulator says: 1 lifted, 0 not, NaN not tried."""
    holds: Bool[Tensor, "N"]
    """It is clear of everything and holds so many times its weight as labels do, its own at least."""


def propose(
    path: Path,
    dataset: Dataset,
    views: Sequence[int],
    settings: ScorerSettings,
    seed: int,
    workers: int,
    label: str,
    own: bool = False,
) -> Proposals:
    """Return what the network at `path` proposes in these views; the same for any number of workers.

    Random proposals, some of them executed; with `own` those that the network's scorer thinks best of each object, all
    executed. `label` is for the progress bar.
    """
    stamp = path.stat().st_mtime_ns
    jobs = (joblib.delayed(_of_view)(path, stamp, dataset, view, settings, seed, own) for view in views)
    return Proposals.cat(list(track(in_workers(jobs, workers), label, total=len(views))))


@one_thread()
@torch.no_grad()
def _of_view(
    path: Path, stamp: int, dataset: Dataset, index: int, settings: ScorerSettings, seed: int, own: bool
) -> Proposals:
    """Return some of the grasps told in one view, judged; the worker's only entry.

    Random ones, some of them executed; with `own` those that the model thinks best of each object, all executed.
    """
    model, hand = _network(path, stamp), dataset.hand
    view = levelled(dataset.view(index))
    cloud = torch.cat([view.points, view.normals], dim=1)
    features, seeds, told = model.told(cloud, choices=settings.choices, most=settings.most)
    grasps = Grasps.cat(told).replace(object=view.instance[seeds].repeat(len(told)))
    # As prediction would have them carried out; the scorer sees them as they are told.
    set_up = replace(model.selection, upright=settings.upright, raised=settings.raised)
    done = on_table(hand, dataset.shape, grasps, LEVEL, set_up)
    coarse = coarse_points(cloud, SPREAD)
    if own:
        assert model.scorer is not None
        at = cloud[seeds].repeat(len(told), 1)
        score = model.scorer(features, at, grasps, *model.scorer.look(grasps, coarse))
        rows = _best(model, done.replace(quality=score.sigmoid()), coarse, settings)
    else:
        order = torch.from_numpy(stream(seed, "proposals", index).permutation(len(grasps)))
        rows = _some(model, dataset, done, coarse, settings, order)
    grasps, done, at = grasps[rows], done[rows], rows % len(seeds)
    truth = scene_truth(dataset, dataset.scene_of(index), view.world_T_camera.double())
    found = truth.outcome(done)
    # 0: one finger or none; else by how many times its weight the object is held.
    held = torch.where(found.penetration <= truth.settings.penetration, found.capacity, 0.0)
    kind = 1 + torch.bucketize(held, torch.tensor(settings.capacity).to(held), right=True)
    kind[found.touched < 2] = 0
    worth = torch.where(found.clear, torch.tensor(settings.clear)[kind], torch.tensor(settings.blocked)[kind])
    holds = found.clear & (held >= max(truth.settings.capacity, 1.0))
    where = cloud[seeds[at]]
    around, swept = (part.half() for part in look(hand, grasps, coarse, settings.sweep, settings.along))
    lifted = torch.full_like(worth, torch.nan)
    tried = len(grasps) if own else settings.verdicts
    lifted[:tried] = _executed(dataset, view, done[:tried], index, settings.protocol)
    told_by = features[at], where, grasps.pose, grasps.joints, around, swept, grasps.quality
    return Proposals(*told_by, facts(hand, done, found), worth, lifted, holds)


def _some(
    model: GraspNet,
    dataset: Dataset,
    grasps: Grasps,
    coarse: Float[Tensor, "Q 6"],
    settings: ScorerSettings,
    order: Int[Tensor, "N"],
) -> Int[Tensor, "P"]:
    """Return the first free ones in an order: on objects, where it is hard to tell.

    A few elsewhere, so that the table is known not to be graspable.
    """
    on = grasps.object[order] >= 0
    rows = torch.cat([order[on][: DRAWN * settings.per_view], order[~on][: settings.per_view // 10]])
    # What prediction rules out by itself teaches nothing.
    passed = free(model.hand, dataset.shape, grasps[rows], coarse[:, :3], LEVEL, model.selection)
    return rows[passed][: settings.per_view]


def _best(model: GraspNet, grasps: Grasps, coarse: Float[Tensor, "Q 6"], settings: ScorerSettings) -> Int[Tensor, "P"]:
    """Return the grasps of each object that would be offered first, as many as are asked for."""
    rows = [torch.zeros(0, dtype=torch.long)]
    for number in grasps.object[grasps.object >= 0].unique():
        own = (grasps.object == number).nonzero().flatten()
        known = grasps[own].replace(object=own)  # so that it is known which ones come back
        rows.append(select(model.hand, known, coarse, settings.chosen, model.selection, LEVEL).object)
    return torch.cat(rows)


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
