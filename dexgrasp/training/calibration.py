"""Batch statistics and validation of the averaged weights."""

import torch
from torch import nn

from dexgrasp.dataset.samples import Samples
from dexgrasp.model import GraspNet
from dexgrasp.threads import one_thread
from dexgrasp.training.settings import TrainerSettings, order


@one_thread()
@torch.no_grad()
def calibrate(model: GraspNet, samples: Samples, settings: TrainerSettings, seed: int, device: torch.device) -> None:
    """Measure the batch norms' running statistics for the present weights over some micro-batches."""
    norms = [module for module in model.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over the batches that follow
    model.to(device).train()
    for step in range(max(1, settings.calibrate // settings.batch)):
        for indices in order(len(samples), settings, seed, step):
            batch = samples.batch(indices).to(device)
            model(batch.cloud, batch.plan, batch.targets)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    model.eval()


@one_thread()
@torch.no_grad()
def validate(model: GraspNet, samples: Samples, settings: TrainerSettings, device: torch.device) -> dict[str, float]:
    """Return the mean of every loss term over a split, in eval mode."""
    model.to(device).eval()
    totals: dict[str, float] = {}
    size = settings.batch // settings.shards
    starts = range(0, len(samples), size)
    for start in starts:
        batch = samples.batch(range(start, min(start + size, len(samples)))).to(device)
        prediction, _ = model(batch.cloud, batch.plan, batch.targets)
        for name, value in model.representation.loss(prediction, batch.targets).items():
            totals[name] = totals.get(name, 0.0) + float(value) / len(starts)
    return totals
