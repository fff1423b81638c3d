"""What the labels themselves reach in the simulator: the ceiling of whatever learns from them."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.execution import tilted
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.seeds import stream
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.simulator import Simulator

CHUNK = 8
"""Labels that the oracle tries at a time."""


def ceilings(
    index: int,
    objects: Sequence[Object],
    poses: Float[Tensor, "O 4 4"],
    labels: Grasps,
    hand: Hand,
    simulator: Simulator,
    protocol: Protocol,
    seed: int,
    fixtures: Boxes | None = None,
    oracle: int = 0,
    worth: Float[Tensor, "N"] | None = None,
) -> dict[str, list[bool]]:
    """Execute, for each object of the untouched scene, its best label by epsilon and a random one.

    `labels` are the feasible grasps of the scene (world frame); an object without any is not counted. With `worth` of
    each label, also the one of most worth. With `oracle`, also whether any of so many labels of an object holds, the
    best (by `worth`, else by epsilon) first and others at random; there an object without a label counts as a failure.
    """
    kinds = ["best_epsilon", "random"] if worth is None else ["best", "best_epsilon", "random"]
    chosen: dict[str, list[Grasps]] = {kind: [] for kind in kinds}
    worth = labels.quality if worth is None else worth
    steep = tilted(hand, labels, protocol.verdict.max_tilt)
    for row in range(len(objects)):
        own = ((labels.object == row) & ~steep).nonzero().flatten()
        if len(own) == 0:
            continue
        if "best" in chosen:
            chosen["best"].append(labels[int(own[worth[own].argmax()])])
        chosen["best_epsilon"].append(labels[int(own[labels.quality[own].argmax()])])
        chosen["random"].append(labels[int(own[int(stream(seed, "ceiling", index, row).integers(len(own)))])])
    verdicts: dict[str, list[bool]] = {}
    for kind, grasps in chosen.items():
        outcomes = (
            simulator.execute(objects, poses, hand, Grasps.cat(grasps), protocol, fixtures=fixtures) if grasps else None
        )
        verdicts[kind] = [] if outcomes is None else [bool(x) for x in outcomes.success]
    if oracle:
        verdicts["oracle"] = []
        for row in range(len(objects)):
            rows = ((labels.object == row) & ~steep).nonzero().flatten().numpy()
            rows = rows[np.argsort(-worth[rows].numpy(), kind="stable")]
            rest = stream(seed, "oracle", index, row).permutation(rows[1:])
            tried = labels[torch.from_numpy(np.r_[rows[:1], rest][:oracle])]
            verdicts["oracle"].append(
                any(
                    bool(simulator.execute(objects, poses, hand, part, protocol, fixtures=fixtures).success.any())
                    for part in (tried[i : i + CHUNK] for i in range(0, len(tried), CHUNK))
                )
            )
    return verdicts
