"""Prediction by a CUDA graph: constants are copied once, and where there is no graph it says so and predicts anyway."""

import logging
from contextlib import nullcontext

import pytest
import torch
from hydra import compose, initialize_config_dir
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from dexgrasp import config
from dexgrasp.errors import DexgraspError
from dexgrasp.graph import Captured, Constants, joined
from dexgrasp.model import GraspNet, build_model, load_model, save_model
from dexgrasp.scorer import Scorer
from dexgrasp.testing.samples import seen

CUDA = torch.cuda.is_available()
SMALL = ["backbone.points=[600,64]", "backbone.radii=[0.04,0.12]", "backbone.neighbours=[8,8]"]
SMALL += ["backbone.widths=[[16,16],[32,32]]", "backbone.decoder=[[24]]"]


def network(representation: str, hand: str = "barrett") -> GraspNet:
    config.register()
    with initialize_config_dir(str(config.conf_folder()), version_base="1.3"):
        composed = compose("train", overrides=[f"hand={hand}", f"repr={representation}", *SMALL])
    torch.manual_seed(0)
    model = build_model(composed, points=1000)
    model.scorer = Scorer(
        model.hand,
        model.backbone.channels,
        choices=2,
        most=40,
        sweep=(-0.1, 0.1),
        along=(0.0, 1.0),
    )
    return model.eval()


def cloud(seed: int = 0, count: int = 1000) -> torch.Tensor:
    points = seen(count, seed)
    return torch.cat([points, torch.nn.functional.normalize(-points, dim=1)], dim=1)


@pytest.fixture(scope="module")
def model() -> GraspNet:
    return network("contact")


class Crossings(TorchDispatchMode):
    """Counts the operations that take what lies on two devices, or from one to another: of these a graph has none."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        inside = [leaf for leaf in tree_leaves((args, kwargs, out)) if isinstance(leaf, torch.Tensor)]
        if len({tensor.device for tensor in inside}) > 1:
            self.found.append(str(func))
        return out


@pytest.mark.parametrize(
    ("representation", "hand"), [("contact", "barrett"), ("pose", "allegro_right"), ("contact_width", "panda")]
)
def test_a_prediction_takes_only_recorded_constants_from_the_cpu(representation, hand, monkeypatch):
    """On the meta device, which computes shapes only: whoever asks for values there, as no graph can, fails."""
    monkeypatch.setattr(torch, "autocast", lambda *args, **kwargs: nullcontext())  # knows no meta device
    model = network(representation, hand)
    there = torch.device("meta")
    plan = {name: rows.long().to(there) for name, rows in model.backbone.plan(cloud()[:, :3]).items()}
    given, coarse = torch.empty(1000, 6, device=there), torch.empty(512, dtype=torch.long, device=there)
    model.to(there)
    constants = Constants(there)
    for _ in range(2):  # what is kept from call to call is made in the first
        with constants.record():
            before = model.propose(given, plan, coarse)
    crossings = Crossings()
    with crossings, constants.replay():
        after = model.propose(given, plan, coarse)
    assert constants.kept and not crossings.found
    for name, value in before.tensors().items():
        assert after.tensors()[name].shape == value.shape and value.device == there


def test_constants_are_what_was_copied():
    constants = Constants(torch.device("meta"))
    x = torch.ones(3, device="meta")
    with constants.record():
        first = [torch.zeros(3).to("meta"), x.new_tensor([1, 2]), torch.tensor([1.0], device="meta")]
    assert [id(tensor) for tensor in constants.kept] == [id(tensor) for tensor in first]
    with constants.replay():
        second = [torch.zeros(3).to("meta"), x.new_tensor([1, 2]), torch.tensor([1.0], device="meta")]
        assert torch.tensor([1]).device.type == "cpu"
    assert all(a is b for a, b in zip(first, second, strict=True))
    with pytest.raises(RuntimeError, match="more constants"), constants.replay():
        [torch.zeros(3).to("meta") for _ in range(4)]
    with pytest.raises(RuntimeError, match="fewer constants"), constants.replay():
        pass
    with pytest.raises(RuntimeError, match="in place"), constants.record():
        torch.zeros(3).to("meta").add_(1)


def test_joined_layers_predict_the_same(model):
    given = cloud()
    found, expected = joined(model).propose(given), model.propose(given)
    for name, value in found.tensors().items():
        torch.testing.assert_close(value, expected.tensors()[name], equal_nan=True, atol=1e-4, rtol=1e-4)
    norms = [sum(isinstance(m, torch.nn.BatchNorm1d) for m in net.modules()) for net in (joined(model), model)]
    assert norms[0] < norms[1] and model.scorer is not None


def test_without_cuda_it_says_so_and_predicts(model, caplog):
    captured, given = Captured(model), cloud()
    with caplog.at_level(logging.WARNING):
        grasps = [captured(given), captured(given)]
    assert [record.message for record in caplog.records] == ["no CUDA graph: the network is not on a CUDA device"]
    assert torch.equal(grasps[0].pose, model.propose(given).pose)


def test_a_checkpoint_is_loaded_as_told(model, tmp_path):
    path = tmp_path / "model.safetensors"
    save_model(path, model)
    loaded = load_model(path, precision="bfloat16", captured=True)
    assert loaded.captured is not None and len(loaded.predict(seen(1200))) >= 0
    half, whole = loaded._features(cloud()[None], None)[0], model._features(cloud()[None], None)[0]
    assert half.dtype == torch.float32 and not torch.equal(half, whole)
    assert (half - whole).norm() < 0.02 * whole.norm()
    with pytest.raises(DexgraspError, match="float32 or bfloat16"):
        load_model(path, precision="float16")
    with pytest.raises(DexgraspError, match="auto, cpu, cuda"):
        load_model(path, device="gpu")
    if not CUDA:
        with pytest.raises(DexgraspError, match="torch sees none"):
            load_model(path, device="cuda")


@pytest.mark.gpu
@pytest.mark.skipif(not CUDA, reason="needs CUDA")
@pytest.mark.parametrize("representation", ["contact", "pose"])
def test_a_graph_gives_what_eager_gives(representation):
    model = network(representation).cuda()
    captured = Captured(model)
    for seed in (0, 1, 0, 2):
        given = cloud(seed).cuda()
        found, expected = captured(given), model.propose(given)
        assert captured.eager is None
        for name, value in found.tensors().items():
            torch.testing.assert_close(value, expected.tensors()[name], equal_nan=True)
    assert len(captured(cloud(0, 900).cuda())) == len(model.propose(cloud(0, 900).cuda()))  # another size: eager
