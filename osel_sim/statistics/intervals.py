"""Intervals for what is measured: proportions and means."""

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError

Interval = tuple[float, float]
"""Low and high end."""


def wilson_interval(successes: float, trials: float, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion. Holds its coverage for few trials and near 0 and 1, where the normal approximation does not.

    Args:
        successes: in [0, trials].
        trials: not whole where trials depend on one another (`effective_trials`); with none, nothing is known: (0, 1).
        confidence: in (0, 1).

    Raises:
        UsageError: a number out of range.
    """
    if not 0 <= successes <= trials:
        raise UsageError(f"successes must lie in [0, {trials}], got {successes}")
    z = NormalDist().inv_cdf(0.5 + _checked(confidence) / 2.0)
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1.0 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1.0 + z * z / trials
    # The ends are exactly 0 and 1 at no and at full success; rounding must not say otherwise.
    low = 0.0 if successes == 0 else (centre - half) / scale
    high = 1.0 if successes == trials else (centre + half) / scale
    return low, high


def effective_trials(rates: ArrayLike, trials: float) -> float:
    """How many independent trials are worth as much as several on each of some instances, of which those on one instance are alike.

    The number at which a binomial proportion would vary as the mean of the instances' rates does, but no fewer than there are instances and no more
    than there were trials.

    Args:
        rates: (N,) share of successes on each instance.
        trials: how many there were.
    """
    own = np.asarray(rates, np.float64).ravel()
    rate, variance = float(own.mean()), float(own.var(ddof=1)) if own.size > 1 else 0.0
    if rate in (0.0, 1.0) or variance == 0.0:
        return float(own.size)
    return float(np.clip(rate * (1.0 - rate) * own.size / variance, own.size, max(trials, own.size)))


RESAMPLES = 10_000
"""How often values are drawn anew for a bootstrap interval, unless said otherwise."""


def bootstrap_means(values: ArrayLike, seed: int = 0, resamples: int = RESAMPLES) -> NDArray[np.float64]:
    """Means of the values drawn anew with replacement, (resamples,). The same seed draws the same.

    Args:
        values: at least one finite number.

    Raises:
        UsageError: no values, or one that is not finite.
    """
    sample = np.asarray(values, np.float64).ravel()
    if not sample.size or not np.isfinite(sample).all():
        raise UsageError(f"the mean of {sample.size} values needs at least one, all finite")
    generator = np.random.default_rng(seed)
    # A slice at a time, so that many values do not become a table of gigabytes; its size does not change the numbers drawn.
    rows = max(1, 1_000_000 // sample.size)
    return np.concatenate(
        [sample[generator.integers(sample.size, size=(min(rows, resamples - done), sample.size))].mean(axis=1) for done in range(0, resamples, rows)]
    )


def bootstrap_mean_interval(values: ArrayLike, seed: int = 0, resamples: int = RESAMPLES, confidence: float = 0.95) -> Interval:
    """Percentile bootstrap interval of a mean. The same seed gives the same interval.

    Args:
        values: at least one finite number.
        seed: of the resampling.
        resamples: how often the values are drawn anew, with replacement.
        confidence: in (0, 1).

    Raises:
        UsageError: no values, or one that is not finite.
    """
    tail = (1.0 - _checked(confidence)) / 2.0
    low, high = np.quantile(bootstrap_means(values, seed, resamples), [tail, 1.0 - tail])
    return float(low), float(high)


def _checked(confidence: float) -> float:
    if not 0.0 < confidence < 1.0:
        raise UsageError(f"confidence must lie strictly between 0 and 1, got {confidence}")
    return confidence
