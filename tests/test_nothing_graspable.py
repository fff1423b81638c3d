"""Views in which nothing can be grasped, or of which nothing is known, do not stop or spoil a training."""

from itertools import product

import pytest
import torch

from dexgrasp.checkpoint import read_tensors
from dexgrasp.dataset.samples import collect
from dexgrasp.model import GraspNet
from dexgrasp.plugins import load_backbone, load_hand, load_representation
from dexgrasp.representation import Targets
from dexgrasp.training.loop import train
from dexgrasp.training.settings import TrainerSettings
from dexgrasp.training.state import FILE

BACKBONES = {
    "pointnet": {"points": 32},
    "pointnet2": {
        "points": [32, 8],
        "radii": [0.3, 0.6],
        "neighbours": [8, 8],
        "widths": [[16, 16], [16, 16]],
        "decoder": [[16]],
        "stem": 8,
    },
}


def target(kind: str, points: int, size: int) -> Targets:
    """Targets of one view: `none` graspable, `unknown`, or `some` graspable."""
    finger = torch.zeros(points, dtype=torch.long)
    if kind == "some":
        finger[:8] = torch.arange(8) % 3 + 1
    if kind == "unknown":
        finger[:] = 1
    told = torch.full((points,), kind != "unknown")
    parameters = torch.where((finger > 0).unsqueeze(-1), 0.3, 0.0).expand(points, size).clone()
    return Targets(finger, parameters, 0.1 * (finger > 0), told)


@pytest.mark.parametrize("views", [("none", "none"), ("unknown", "unknown"), ("some", "none"), ("some", "unknown")])
@pytest.mark.parametrize(("backbone", "told"), list(product(BACKBONES, ("contact", "pose"))))
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_trains_to_finite_weights(tmp_path, precision, backbone, told, views):
    torch.manual_seed(0)
    body = load_backbone(backbone, **BACKBONES[backbone])
    model = GraspNet(body, load_representation(told, load_hand("barrett"), body.channels, hidden=[16]), 64)

    def read(view: int) -> tuple[torch.Tensor, Targets]:
        cloud = torch.rand(64, 6, generator=torch.Generator().manual_seed(view))
        return cloud, target(views[view], 64, model.representation.size)

    samples = collect(range(2), read, body, tmp_path / "samples", "samples")
    # One view a micro-batch: with views of two kinds, one micro-batch has nothing to learn from.
    settings = TrainerSettings(
        steps=3, batch=2, shards=2, processes=1, device="cpu", precision=precision, warmup=1, calibrate=2, log_every=1
    )
    before = {key: value.clone() for key, value in model.state_dict().items()}
    summary = train(model, samples, samples, settings, seed=0, folder=tmp_path)
    tensors, _ = read_tensors(tmp_path / FILE)  # weights, their mean, and the optimiser's means of gradients
    strange = [key for key, value in tensors.items() if not bool(value.isfinite().all())]
    assert not strange
    numbers = [*summary.losses.values(), *summary.validation.values()]
    assert len(numbers) > 6 and all(map(torch.isfinite, map(torch.tensor, numbers)))
    terms = set(summary.losses) - {"finger"}
    if "some" in views:
        assert all(summary.losses[name] > 0 for name in terms)
    else:
        assert all(summary.losses[name] == 0 for name in terms)
    if "unknown" in views and "some" not in views:
        assert summary.losses["finger"] == 0
    else:
        assert any(
            not torch.equal(before[key], value)
            for key, value in model.state_dict().items()
            if "finger" in key or "stage_1" in key
        )
