"""95 % intervals for success rates, and how well a score tells success from failure."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import rankdata
from torch import Tensor

from dexgrasp.seeds import stream

Z = 1.959963984540054


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson score interval of a rate from independent trials; (0, 1) without any trial."""
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    centre = rate + Z**2 / (2 * trials)
    spread = Z * np.sqrt(rate * (1 - rate) / trials + Z**2 / (4 * trials**2))
    scale = 1 + Z**2 / trials
    # Without a failure, or a success, one end is the rate itself, but for rounding.
    low = 0.0 if successes == 0 else float((centre - spread) / scale)
    high = 1.0 if successes == trials else float((centre + spread) / scale)
    return low, high


def bootstrap_ratio(
    numerators: Sequence[float], denominators: Sequence[float], seed: int = 0, draws: int = 4000
) -> tuple[float, float]:
    """Return the percentile interval of sum(numerators) / sum(denominators), resampling whole scenes.

    Attempts within one scene depend on each other, scenes do not.
    """
    top, bottom = np.asarray(numerators, float), np.asarray(denominators, float)
    if len(top) == 0 or bottom.sum() == 0:
        return 0.0, 1.0
    rows = stream(seed, "bootstrap").integers(len(top), size=(draws, len(top)))
    sums = bottom[rows].sum(axis=1)
    ratios = top[rows].sum(axis=1)[sums > 0] / sums[sums > 0]
    low, high = np.percentile(ratios, [2.5, 97.5])
    return float(low), float(high)


def rate_interval(wins: Sequence[int], tries: Sequence[int], seed: int = 0) -> tuple[tuple[float, float], str]:
    """Return the interval of sum(wins) / sum(tries) over groups (scenes, objects), and its kind.

    Attempts of one group depend on each other: `bootstrap` over groups. `wilson` where each group has one attempt, or
    there is one group, whose attempts then stand for themselves. Where all end alike there is nothing to draw from:
    `wilson over groups`, as if each group were one attempt.
    """
    met = [count for count in tries if count > 0]
    if len(met) < 2 or max(met) == 1:
        return wilson(sum(wins), sum(tries)), "wilson"
    if sum(wins) in (0, sum(tries)):
        return wilson(len(met) if sum(wins) else 0, len(met)), "wilson over groups"
    return bootstrap_ratio(wins, tries, seed), "bootstrap"


def roc_area(scores: Float[Tensor, "N"], truth: Bool[Tensor, "N"]) -> float | None:
    """Return the area under the ROC: how often a true one scores more than a false one; ties count half.

    None where all are alike.
    """
    wins, losses = int(truth.sum()), int((~truth).sum())
    if not wins or not losses:
        return None
    ranks = rankdata(scores.detach().double().cpu().numpy())
    return float((ranks[truth.cpu().numpy()].sum() - wins * (wins + 1) / 2) / (wins * losses))


def roc_curve(
    scores: Float[Tensor, "N"], truth: Bool[Tensor, "N"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """Return the shares of false and of true ones that score at least each threshold, from none to all."""
    values, inverse = np.unique(-scores.detach().double().cpu().numpy(), return_inverse=True)
    good = truth.cpu().numpy()
    counts = [np.bincount(inverse[part], minlength=len(values)).cumsum() for part in (~good, good)]
    false, true = (np.r_[0.0, count / max(count[-1], 1)] if len(count) else np.zeros(1) for count in counts)
    return false, true
