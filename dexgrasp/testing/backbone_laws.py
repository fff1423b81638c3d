"""Laws of a backbone."""

import copy

import torch
from torch import Tensor

from dexgrasp.backbone import Backbone, Plan
from dexgrasp.testing import samples
from dexgrasp.testing.law import expect, expect_close

POINTS = 2500
TOLERANCE = 1e-3


def channels_are_true(backbone: Backbone) -> None:
    """Features have `channels` numbers, one row for each seed; seeds are indices of points."""
    cloud = samples.cloud(2, POINTS)
    features, seeds = _run(backbone, cloud)
    expect(
        features.ndim == 3 and features.shape[::2] == (2, backbone.channels),
        f"features (2, M, {backbone.channels}), as `channels` says",
        tuple(features.shape),
        "`channels` is not the last layer's size",
    )
    expect(seeds.shape == features.shape[:2], f"seeds of shape {tuple(features.shape[:2])}", seeds.shape, "another M")
    inside = seeds.dtype == torch.int64 and bool((seeds >= 0).all() and (seeds < POINTS).all())
    expect(inside, f"seeds: int64 in 0..{POINTS - 1}", (seeds.dtype, int(seeds.min()), int(seeds.max())), "a mask")
    expect(features.isfinite().all(), "finite features", "NaN or infinity", "a neighbourhood without points")


def a_plan_made_before_changes_nothing(backbone: Backbone) -> None:
    """Features are the same with plans from the data loader and with plans made on the fly."""
    cloud = samples.cloud(2, POINTS, seed=1)
    plans = [backbone.plan(item[:, :3]) for item in cloud]
    expect("seeds" in plans[0], "`seeds` in a plan", sorted(plans[0]), "it is always there by contract")
    stacked: Plan = {name: torch.stack([plan[name] for plan in plans]) for name in plans[0]}
    with_plan, seeds = _run(backbone, cloud, stacked)
    without, own_seeds = _run(backbone, cloud)
    expect(torch.equal(seeds, own_seeds), "the same seeds", "others", "plan is not deterministic")
    expect_close(
        with_plan, without, TOLERANCE, "the same features with a plan made before", "plan is not deterministic"
    )


def permuting_points_permutes_features(backbone: Backbone) -> None:
    """The order of the points makes no difference, up to their renaming."""
    cloud = samples.cloud(1, POINTS, seed=2)
    order = torch.randperm(POINTS, generator=torch.Generator().manual_seed(0))
    features, seeds = _run(backbone, cloud)
    permuted, other = _run(backbone, cloud[:, order])
    (names, rows), (other_names, other_rows) = seeds[0].sort(), order[other[0]].sort()
    expect(
        torch.equal(names, other_names),
        "the same seed points in any order of the points",
        f"{len(set(names.tolist()) - set(other_names.tolist()))} of {len(names)} are others",
        "sampling that starts at the first point, or breaks ties by order",
    )
    expect_close(
        permuted[0, other_rows],
        features[0, rows],
        TOLERANCE,
        "the same features in any order",
        "neighbours cut by order",
    )


def batch_items_do_not_mix(backbone: Backbone) -> None:
    """In eval, a cloud's features do not depend on the clouds beside it."""
    cloud = samples.cloud(2, POINTS, seed=3)
    together, _ = _run(backbone, cloud)
    for i in range(2):
        alone, _ = _run(backbone, cloud[i : i + 1])
        expect_close(
            together[i], alone[0], TOLERANCE, "the same features alone", "statistics or indices across the batch"
        )


def gradients_reach_every_parameter(backbone: Backbone) -> None:
    """Features have a gradient for every parameter."""
    model = copy.deepcopy(backbone).train()
    model.zero_grad()
    features, _ = model(samples.cloud(2, POINTS, seed=4))
    (features * torch.randn(features.shape, generator=torch.Generator().manual_seed(5))).sum().backward()
    for name, parameter in model.named_parameters():
        reached = parameter.grad is not None and bool(parameter.grad.abs().sum() > 0)
        expect(reached, f"a gradient of {name}", parameter.grad, "a layer that is made but not used")


def _run(backbone: Backbone, cloud: Tensor, plan: Plan | None = None) -> tuple[Tensor, Tensor]:
    model = copy.deepcopy(backbone).eval()
    with torch.no_grad():
        features, seeds = model(cloud, plan)
    return features, seeds


LAWS = (
    channels_are_true,
    a_plan_made_before_changes_nothing,
    permuting_points_permutes_features,
    batch_items_do_not_mix,
    gradients_reach_every_parameter,
)
