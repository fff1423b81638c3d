"""Synergies: postures from few amplitudes, declared in YAML or computed from grasps."""

import pytest
import torch
import yaml

from dexgrasp import load_hand
from dexgrasp.__main__ import main
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.seeds import stream
from dexgrasp.synergies import Synergy, eigengrasps, synergetic


@pytest.fixture
def claw():
    """A hand of our own copy: tests change its synergies."""
    return load_hand("barrett")


def drawn(hand, count: int = 400):
    rng = stream(0, "test")
    low, high = hand.limits.T
    start = low + (high - low) * torch.from_numpy(rng.uniform(size=(count, len(low))))
    return start, synergetic(hand, start, rng)


def test_eigengrasps_find_the_subspace_that_grasps_lie_in(claw) -> None:
    low, high = claw.limits.T
    middle, span = (low + high) / 2, high - low
    first = torch.tensor([0.0, 1.0, 1.0, 1.0]).double() / 3**0.5
    second = torch.tensor([1.0, 0.0, 0.0, 0.0]).double()
    rng = stream(0, "grasps")
    amplitudes = torch.from_numpy(rng.normal(size=(300, 2))) * torch.tensor([0.1, 0.05])
    joints = middle + amplitudes @ torch.stack([first, second]) * span
    found, shares = eigengrasps(claw, joints, 2)
    assert float(shares.sum()) == pytest.approx(1.0) and shares[0] > shares[1]
    axes = found.axes / span
    assert torch.allclose(axes @ axes.T, torch.eye(2).double(), atol=1e-9)
    assert abs(float(axes[0] @ first)) > 0.99
    claw.synergies = {"eigen": found}
    _, postures = drawn(claw)
    away = (postures - found.mean) / span
    assert torch.allclose(away, away @ axes.T @ axes, atol=1e-9)  # none leaves the subspace, or the limits
    assert torch.equal(claw.clamp(postures), postures)
    own = (away @ axes.T).numpy()
    assert (own >= found.amplitudes[:, 0].numpy() - 1e-9).all() and (own <= found.amplitudes[:, 1].numpy() + 1e-9).all()
    again = Synergy.read("eigen", found.told(), claw)
    assert torch.allclose(again.postures(torch.zeros(1, 2).double()), found.mean, atol=1e-5)


def test_declared_synergies_leave_other_joints_alone_and_are_drawn_alike(claw) -> None:
    pinch = {"open": {"finger_1": 0.2, "finger_3": 0.2}, "closed": {"finger_1": 1.2, "finger_3": 2.2}}
    told = {"pinch": pinch, "wide": {"open": {"spread": 0.0}, "closed": {"spread": 0.1}}}
    claw.synergies = {name: Synergy.read(name, given, claw) for name, given in told.items()}
    start, postures = drawn(claw)
    wide = postures[:, 0] != start[:, 0]
    assert 0.4 < float(wide.double().mean()) < 0.6 and float(postures[wide, 0].max()) <= 0.1
    assert torch.equal(postures[wide, 1:], start[wide, 1:]) and torch.equal(postures[~wide, 2], start[~wide, 2])
    part = postures[~wide, 1] - 0.2
    assert torch.allclose((postures[~wide, 3] - 0.2) / 2, part, atol=1e-9) and part.min() >= 0 and part.max() <= 1
    claw.synergies = {}
    start, same = drawn(claw)
    assert torch.equal(start, same)


@pytest.mark.parametrize(
    "given",
    [
        {"open": {"finger_1": 0}},
        {"open": {"finger_1": 0}, "closed": {"finger_2": 1}},
        {"open": {"thumb": 0}, "closed": {"thumb": 1}},
        {"mean": {"finger_1": 0}, "axes": [{"finger_1": 1}], "amplitudes": [[1, 0]]},
        {"mean": {"finger_1": 0}, "axes": [{"finger_2": 1}, {"spread": 1}], "amplitudes": [[0, 1]]},
        {"opened": {}},
        [],
    ],
)
def test_wrong_synergies_are_told(claw, given) -> None:
    with pytest.raises(DexgraspError, match="synergy 'x' of hand"):
        Synergy.read("x", given, claw)


def test_too_few_grasps_are_told(claw) -> None:
    with pytest.raises(DexgraspError, match="eigengrasps"):
        eigengrasps(claw, claw.limits.T, 2)


def test_command_writes_a_hand_that_draws_from_eigengrasps(claw, tmp_path, monkeypatch, capsys) -> None:
    joints = drawn(claw, 50)[0]
    grasps = Grasps.build(torch.eye(4).double().repeat(50, 1, 1), joints, 3)

    class Made(Dataset):
        def __init__(self) -> None:
            self.hand_config = {"name": "barrett"}
            self.grasps = lambda number: grasps

        def store(self, stage):
            return [stage]

    monkeypatch.setattr("dexgrasp.dataset.dataset.open_dataset", lambda path: Made())
    monkeypatch.chdir(tmp_path)
    assert main(["hand", "synergies", "barrett", "grasps=data", "count=2"]) == 0
    assert "50 grasps; 2 eigengrasps" in capsys.readouterr().out
    told = yaml.safe_load((tmp_path / "hand" / "barrett_eigen.yaml").read_text())
    assert told["defaults"][0] == "barrett" and set(told["synergies"]) == {"eigen"}
    hand = load_hand("barrett", synergies=told["synergies"])
    assert hand.synergies["eigen"].axes.shape == (2, 4)
