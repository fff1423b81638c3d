import numpy as np
import pytest
import torch

from dexgrasp.reliability import reliability
from dexgrasp.statistics import bootstrap_ratio, wilson


def test_wilson_known_values():
    # Newcombe (1998), example a: 81 of 263
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    for trials in range(1, 60):  # without successes or failures an end is the rate, whatever the rounding
        assert wilson(0, trials)[0] == 0.0 and wilson(trials, trials)[1] == 1.0


def test_bootstrap_covers_and_repeats():
    generator = np.random.default_rng(0)
    hits = 0
    for _ in range(60):
        trials = generator.integers(3, 8, size=40)
        successes = generator.binomial(trials, 0.7)
        low, high = bootstrap_ratio(successes, trials, draws=500)
        hits += low <= 0.7 <= high
        assert low <= successes.sum() / trials.sum() <= high
    assert hits >= 50
    assert bootstrap_ratio([1, 2], [2, 2]) == bootstrap_ratio([1, 2], [2, 2])


def test_bootstrap_resamples_scenes_not_attempts():
    scenes = bootstrap_ratio([10, 0], [10, 10])
    attempts = bootstrap_ratio([1] * 10 + [0] * 10, [1] * 20)
    assert scenes[1] - scenes[0] > attempts[1] - attempts[0]


def test_reliability_of_what_one_can_work_out() -> None:
    told, came = torch.tensor([0.25] * 4 + [0.75] * 4), torch.tensor([1, 0, 0, 0, 1, 1, 1, 0]).bool()
    good = reliability(told, came)
    assert good["calibration_error"] == pytest.approx(0) and good["roc_area"] == pytest.approx(0.75)
    assert good["brier_skill"] == pytest.approx(1 - (6 * 0.0625 + 2 * 0.5625) / 8 / 0.25)
    proud = reliability(torch.full((8,), 0.95), came)
    assert proud["calibration_error"] == pytest.approx(0.45) and proud["brier_skill"] < 0
    assert [b["trials"] for b in good["bins"]] == [4, 4]
    assert reliability(told[:0], came[:0])["trials"] == 0
    assert reliability(told, torch.ones(8).bool())["brier_skill"] is None
