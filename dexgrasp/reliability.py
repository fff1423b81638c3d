"""Whether a network's score is the probability that it claims to be: some of its proposals, executed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dexgrasp.execution import tilted
from dexgrasp.grasps import Grasps
from dexgrasp.model import GraspNet
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes, View
from dexgrasp.seeds import stream
from dexgrasp.selection import Selection
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.simulator import Simulator
from dexgrasp.statistics import roc_area

EVERY = 100_000
"""More grasps than any network proposes."""
BINS = 10
CHUNK = 8
"""Grasps that are executed at a time."""


def trials(
    network: GraspNet,
    view: View,
    selection: Selection,
    count: int,
    objects: Sequence[Object],
    poses: Float[Tensor, "O 4 4"],
    simulator: Simulator,
    protocol: Protocol,
    seed: int,
    fixtures: Boxes | None = None,
) -> list[tuple[float, bool]]:
    """Return score and verdict of `count` grasps, each executed on the untouched scene that the view shows.

    They are drawn at random from all proposals that meet neither what the camera saw nor the table, alike or not, so
    that bad ones are among them: what a robot would try first says nothing about low scores.
    """
    every = replace(selection, candidates=EVERY, distance=0.0, min_score=0.0)
    offered = network.predict(view.points, view.normals, EVERY, every, seed).moved(view.world_T_camera)
    offered = offered[~tilted(network.hand, offered, protocol.verdict.max_tilt)]
    drawn = offered[torch.from_numpy(stream(seed, "reliability").permutation(len(offered))[:count])]
    verdicts: list[bool] = []
    for start in range(0, len(drawn), CHUNK):
        part: Grasps = drawn[start : start + CHUNK]
        outcomes = simulator.execute(objects, poses, network.hand, part, protocol, fixtures=fixtures)
        verdicts += [bool(success) for success in outcomes.success]
    return list(zip(drawn.quality.tolist(), verdicts, strict=True))


def reliability(scores: Float[Tensor, "N"], success: Bool[Tensor, "N"]) -> dict[str, Any]:
    """Return how well probabilities foretell success; None where nothing was tried, or all ended alike.

    `calibration_error`: mean gap between what is told and what comes true in `BINS` bins of equal width, weighted by
    their grasps (expected calibration error). `brier_skill`: 1 - Brier score / that of always telling the mean.
    """
    told, came = scores.double().numpy(), success.double().numpy()
    if not len(told):
        return {"trials": 0, "calibration_error": None, "brier_skill": None, "roc_area": None, "bins": []}
    number = np.clip((told * BINS).astype(int), 0, BINS - 1)
    bins = [
        {"told": float(told[rows].mean()), "came": float(came[rows].mean()), "trials": int(rows.sum())}
        for rows in (number == k for k in range(BINS))
        if rows.any()
    ]
    spread = float(np.mean((came.mean() - came) ** 2))
    return {
        "trials": len(told),
        "calibration_error": sum(b["trials"] * abs(b["told"] - b["came"]) for b in bins) / len(told),
        "brier_skill": 1 - float(np.mean((told - came) ** 2)) / spread if spread else None,
        "roc_area": roc_area(scores, success),
        "bins": bins,
    }
