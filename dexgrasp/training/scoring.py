"""Teaching the scorer: the network's own grasps on the training's views, judged on the true objects."""

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from dexgrasp.checkpoint import FILE
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.grasps import Grasps
from dexgrasp.model import GraspNet, save_model
from dexgrasp.reliability import reliability
from dexgrasp.scorer import Scorer
from dexgrasp.seeds import stream, torch_stream
from dexgrasp.statistics import roc_area
from dexgrasp.surroundings import Seen
from dexgrasp.threads import one_thread
from dexgrasp.training.descent import descend
from dexgrasp.training.proposals import Proposals, propose
from dexgrasp.training.scorer_settings import FROM_START, ScorerSettings
from dexgrasp.training.surrogate import FEWEST, Surrogate


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
    chosen: dict[str, Any] | None = None
    """The same of what the scorer itself chose there."""
    promise: float | None = None
    """How likely random grasps of the network on validation views are to lift, as the teacher thinks, in the mean."""
    surrogate: dict[str, Any] | None = None
    """On all that was executed of validation views: areas under the ROC of the surrogate, and of what grasps hold."""


def fit_scorer(
    model: GraspNet,
    path: Path,
    dataset: Dataset,
    settings: ScorerSettings,
    seed: int,
    workers: int,
    start: Scorer | None = None,
) -> ScorerSummary:
    """Give `model` (on the CPU, as it lies at `path`) a scorer taught on the dataset's training views.

    `start`, where it is of the same size and not `settings.anew`, is what it begins with, else it begins with nothing.
    The result does not depend on the number of workers.
    """
    began = time.perf_counter()
    views = dataset.split("train")[: settings.views]
    known = propose(path, dataset, views, settings, seed, workers, "scorer")
    if not len(known):  # nothing to learn from: the heads' own score stays
        return ScorerSummary(0, 0.0, time.perf_counter() - began)
    known, surrogate = _foretold(known, settings, seed)
    model.scorer = scorer = _fitted(model, known, settings, seed, start)
    for turn in range(1, settings.rounds):
        told = f"scorer, its own choice {turn}"
        known = Proposals.cat([known, _choose(model, dataset, views, settings, seed, workers, told)])
        known, surrogate = _foretold(known, settings, seed)
        model.scorer = scorer = _fitted(model, known, settings, seed, start)
    area = before = verdicts = own = promise = foretelling = None
    if unseen := dataset.split("validation"):
        rest = propose(path, dataset, unseen, settings, seed, workers, "scorer, validation")
        told_so = _told_by(scorer, rest)
        area, before = roc_area(told_so, rest.holds), roc_area(rest.score, rest.holds)
        verdicts = _reliable(told_so, rest)
        promise = float(_thought(surrogate, rest).double().mean()) if len(rest) else None
        if settings.rounds > 1:
            chosen = _choose(model, dataset, unseen, settings, seed, workers, "scorer, validation of its choice")
            own = _reliable(_told_by(scorer, chosen), chosen)
            rest = Proposals.cat([rest, chosen])
            told_so = _told_by(scorer, rest)
        tried = ~rest.lifted.isnan()
        if surrogate is not None and tried.any():
            foretelling = _areas(surrogate, rest[tried])
        if tried.any():
            scorer.calibrate(told_so[tried], rest.lifted[tried])
    holding, seconds = float(known.holds.double().mean()), time.perf_counter() - began
    return ScorerSummary(len(known), holding, seconds, area, before, verdicts, own, promise, foretelling)


def _foretold(known: Proposals, settings: ScorerSettings, seed: int) -> tuple[Proposals, Surrogate | None]:
    """Return the proposals with what a surrogate of physics says that they are worth, and it, where there is one."""
    if not settings.surrogate:
        return known, None
    tried = ~known.lifted.isnan()
    if (count := int(tried.sum())) < FEWEST:
        print(f"{count} verdicts, of {FEWEST} for a surrogate: the table judges (scorer.capacity)", file=sys.stderr)
        return known, None
    surrogate = Surrogate.taught(known.facts[tried], known.lifted[tried], seed)
    return known.replace(worth=_thought(surrogate, known)), surrogate


@one_thread()
@torch.no_grad()
def _thought(surrogate: Surrogate | None, known: Proposals) -> Float[Tensor, "N"]:
    return known.worth if surrogate is None else surrogate(known.facts)


def _areas(surrogate: Surrogate, tried: Proposals) -> dict[str, Any]:
    win = tried.lifted > 0
    areas = {"area": roc_area(_thought(surrogate, tried), win), "area_held": roc_area(tried.worth, win)}
    return {"trials": len(tried), **areas}


@one_thread()
@torch.no_grad()
def _told_by(scorer: Scorer, known: Proposals) -> Float[Tensor, "N"]:
    return scorer(known.features, known.at, _grasps(known), *_seen(known))


def _reliable(told: Float[Tensor, "N"], known: Proposals) -> dict[str, Any] | None:
    """Return the reliability of logits on what was executed."""
    tried = ~known.lifted.isnan()
    return reliability(told[tried].sigmoid(), known.lifted[tried] > 0) if tried.any() else None


def _fitted(
    model: GraspNet, known: Proposals, settings: ScorerSettings, seed: int, start: Scorer | None = None
) -> Scorer:
    """Return a scorer that has learnt what is known, from `start` where it is of the same size."""
    torch.manual_seed(int(stream(seed, "scorer").integers(2**31)))
    options = {name: getattr(settings, name) for name in FROM_START}
    scorer = Scorer(model.hand, known.features.shape[1], **options)
    if start is not None and not settings.anew and _sizes(start) == _sizes(scorer):
        scorer.load_state_dict(start.state_dict())
    _fit(scorer, known, settings, seed)
    return scorer


def _sizes(scorer: Scorer) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in scorer.state_dict().items()}


@one_thread()
def _fit(scorer: Scorer, known: Proposals, settings: ScorerSettings, seed: int) -> None:
    def loss_of(index: Int[Tensor, "B"]) -> Float[Tensor, ""]:
        rows = known[index]
        logits = scorer(rows.features, rows.at, _grasps(rows), *_seen(rows))
        tried = ~rows.lifted.isnan()
        wanted = torch.where(tried, rows.lifted, rows.worth)
        return F.binary_cross_entropy_with_logits(logits, wanted, torch.where(tried, settings.weight, 1.0))

    scorer.train()
    how = settings.batch, settings.epochs, settings.learning_rate, settings.weight_decay
    descend(scorer, loss_of, len(known), *how, torch_stream(seed, "scorer order"))
    scorer.eval()


def _seen(known: Proposals) -> Seen:
    return known.around, known.swept


def _grasps(known: Proposals) -> Grasps:
    return Grasps.build(known.pose, known.joints, 1)


def _choose(
    model: GraspNet,
    dataset: Dataset,
    views: Sequence[int],
    settings: ScorerSettings,
    seed: int,
    workers: int,
    label: str,
) -> Proposals:
    """Return what the model with its scorer would do in each view, and what came of it.

    The best of many is the one that was most overrated: only trying it tells.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / FILE
        save_model(path, model)
        return propose(path, dataset, views, settings, seed, workers, label, own=True)
