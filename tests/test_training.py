import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dexgrasp.dataset.samples import Samples, collect
from dexgrasp.errors import DexgraspError
from dexgrasp.model import GraspNet
from dexgrasp.plugins import load_backbone, load_hand, load_representation
from dexgrasp.representation import Targets
from dexgrasp.training.calibration import calibrate, validate
from dexgrasp.training.feed import Feed
from dexgrasp.training.loop import train
from dexgrasp.training.settings import TrainerSettings, order, schedule
from dexgrasp.training.state import FILE

SETTINGS = TrainerSettings(
    steps=6, batch=4, shards=2, device="cpu", learning_rate=0.01, warmup=2, calibrate=4, save_every=1
)


def network():

    torch.manual_seed(0)
    backbone = load_backbone("pointnet", points=32)
    return GraspNet(backbone, load_representation("contact", load_hand("barrett"), backbone.channels, hidden=[16]), 64)


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> Samples:
    model = network()
    generator = torch.Generator().manual_seed(1)

    def read(view: int):
        cloud = torch.rand(64, 6, generator=generator)
        cloud[:, 3:] /= cloud[:, 3:].norm(dim=1, keepdim=True)
        finger = torch.randint(0, 4, (64,), generator=generator)
        parameters = torch.rand(64, model.representation.size, generator=generator) * 0.5
        return cloud, Targets(finger, parameters, torch.rand(64, generator=generator), torch.ones(64, dtype=torch.bool))

    return collect(range(6), read, model.backbone, tmp_path_factory.mktemp("samples") / "train", "samples")


def run(samples, folder: Path, **changes):

    folder.mkdir(exist_ok=True)
    model = network()
    summary = train(model, samples, samples, replace(SETTINGS, **changes), seed=3, folder=folder)
    return model.state_dict(), summary


def same(a, b, **tolerance):
    assert a.keys() == b.keys()
    for key in a:
        torch.testing.assert_close(a[key], b[key], **(tolerance or {"rtol": 0, "atol": 0}), msg=key)


def test_what_is_measured_at_the_end_does_not_depend_on_the_number_of_threads(samples):
    model, seen, before = network(), set(), torch.get_num_threads()
    model.backbone.register_forward_hook(lambda *_: seen.add(torch.get_num_threads()))
    torch.set_num_threads(2)
    try:
        calibrate(model, samples, SETTINGS, 0, torch.device("cpu"))
        validate(model, samples, SETTINGS, torch.device("cpu"))
        assert seen == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_resumes_exactly(samples, tmp_path, precision):
    whole, summary = run(samples, tmp_path / "whole", processes=1, precision=precision)
    assert summary.steps == 6 and not summary.interrupted
    import dexgrasp.training.loop as loop

    class Stop:
        def __init__(self):
            self.asked = 0

        def is_set(self):
            self.asked += 1
            return self.asked == 3

    model, folder = network(), tmp_path / "cut"
    folder.mkdir()
    settings = replace(SETTINGS, precision=precision)
    loop._run(0, 1, 0, model, samples, None, settings, 3, folder, torch.device("cpu"), Stop())
    assert loop.read_tensors(folder / FILE)[1]["step"] == 3
    resumed, _ = run(samples, folder, processes=1, precision=precision)
    same(whole, resumed)


def test_bfloat16_is_used_and_close(samples, tmp_path):
    """Weights stay float32; what they come to differs, but the losses do not by more than rounding of 8 bits."""
    (full, exact), (half, rounded) = (
        run(samples, tmp_path / precision, processes=1, precision=precision, log_every=1)
        for precision in ("float32", "bfloat16")
    )
    assert {value.dtype for value in half.values() if value.is_floating_point()} == {torch.float32}
    assert any(not torch.equal(full[key], half[key]) for key in full)
    assert sum(rounded.validation.values()) == pytest.approx(sum(exact.validation.values()), rel=0.05)


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_same_result_whatever_the_number_of_processes(samples, tmp_path, turn):
    one, _ = run(samples, tmp_path / "one", processes=1, turn=turn)
    two, summary = run(samples, tmp_path / "two", processes=2, turn=turn)
    assert summary.processes == 2
    same(one, two)


def test_views_kept_on_the_device_give_the_same_training(samples, tmp_path):
    one, _ = run(samples, tmp_path / "read", processes=1)
    two, _ = run(samples, tmp_path / "kept", processes=1, resident=True)
    same(one, two)


def test_views_are_read_ahead_for_another_device(samples, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: tensor)  # of which a CPU alone has none
    read = []
    monkeypatch.setattr(Samples, "rows", lambda self, rows, own=Samples.rows: (read.append(rows), own(self, rows))[1])
    batches = Feed(samples, torch.device("meta")).batches([[0, 1], [4], [5, 2]])
    assert next(batches).cloud.shape == (2, 64, 6) and [0, 1] in read and [5, 2] not in read
    rest = list(batches)
    assert [batch.cloud.device.type for batch in rest] == ["meta"] * 2 and [len(batch.cloud) for batch in rest] == [
        1,
        2,
    ]
    assert read == [[0, 1], [4], [5, 2]]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("resident", [True, False])
def test_batches_on_cuda_are_those_of_the_cpu(samples, resident):
    wanted = [[0, 1], [4], [5, 2]]
    for indices, batch in zip(wanted, Feed(samples, torch.device("cuda"), resident).batches(wanted), strict=True):
        expected = samples.batch(indices)
        assert torch.equal(batch.cloud.cpu(), expected.cloud)
        assert all(torch.equal(rows.cpu(), expected.plan[name]) for name, rows in batch.plan.items())
        same(batch.targets.to("cpu").tensors(), expected.targets.tensors())


def test_loss_falls_and_log_is_whole(samples, tmp_path):
    _, summary = run(samples, tmp_path / "long", processes=1, steps=60, log_every=1, ema=0.9)
    rows = list(csv.DictReader((tmp_path / "long" / "metrics.csv").open()))
    totals = [float(row["value"]) for row in rows if row["term"] == "total" and row["split"] == "train"]
    assert len(totals) == 60
    assert sum(totals[-5:]) < 0.8 * sum(totals[:5])
    assert set(summary.validation) and all(value == value for value in summary.validation.values())


def test_every_view_is_seen_once_an_epoch():
    seen = [view for step in range(3) for shard in order(6, SETTINGS, 0, step) for view in shard]
    assert sorted(seen[:6]) == sorted(seen[6:12]) == list(range(6))
    assert order(6, SETTINGS, 0, 1) == order(6, SETTINGS, 0, 1) != order(6, SETTINGS, 1, 1)


def test_schedule_warms_up_and_decays():
    factors = [schedule(step, SETTINGS) for step in range(6)]
    assert factors[0] == 0.5 and factors[1] == 1.0 and factors[1] >= factors[2] > factors[5] > 0


@pytest.mark.parametrize("change", [{"steps": -1}, {"shards": 3}, {"precision": "half"}, {"optimizer": "lion"}])
def test_bad_settings_are_named(change):
    with pytest.raises(DexgraspError):
        TrainerSettings(**{"steps": 1, "batch": 4, "shards": 2} | change)
