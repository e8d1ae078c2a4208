"""A number with its 95% interval, and how to get one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.statistics.intervals import bootstrap_mean_interval, bootstrap_means, effective_trials, wilson_interval

if TYPE_CHECKING:
    from osel_sim.analysis.log import Array

RESAMPLES = 2_000


@dataclass(frozen=True)
class Estimate:
    """A number with its 95% interval."""

    value: float
    low: float
    high: float


def mean_of(values: ArrayLike) -> Estimate | None:
    """Mean of what is not NaN with its bootstrap interval; None of nothing."""
    sample = np.asarray(values, np.float64).ravel()
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return None
    return Estimate(float(sample.mean()), *bootstrap_mean_interval(sample, resamples=RESAMPLES))


def over_instances(values: "Array", instances: NDArray[Any]) -> Estimate | None:
    """Mean of what is not NaN over seeds and decisions, with its bootstrap interval over instances; None of nothing.

    Args:
        values: (S, T) of S seeds, each of which showed instances in another order.
        instances: (S, T), which instance was decided on.
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    low, high = np.quantile(instance_draws(values[known], instances[known], RESAMPLES), [0.025, 0.975])
    return Estimate(float(values[known].mean()), float(low), float(high))


def instance_draws(values: "Array", instances: NDArray[Any], resamples: int) -> "Array":
    """Means of values (n,), the instances (n,) that they are of drawn anew, (resamples,)."""
    _, at = np.unique(instances, return_inverse=True)
    sums, counts = np.bincount(at.ravel(), values), np.bincount(at.ravel())
    # The same seed draws the same instances for both.
    return np.asarray(bootstrap_means(sums, resamples=resamples) / bootstrap_means(counts, resamples=resamples), np.float64)


def rate_of(outcomes: "Array") -> Estimate | None:
    """Share of successes among the outcomes (N, R) that are not NaN; None of nothing.

    Wilson's interval, with as many trials as the repeats of an instance, which are no independent trials, are worth; with graded outcomes a bootstrap
    over instances. The rate is that of the mean instance, so that one with more repeats does not weigh more.
    """
    known = outcomes[np.isfinite(outcomes).any(axis=-1)]
    if not known.size:
        return None
    finite = np.isfinite(known)
    per_instance = np.nanmean(known, axis=-1)
    if not np.isin(known[finite], (0.0, 1.0)).all():
        return mean_of(per_instance)
    rate, trials = float(per_instance.mean()), effective_trials(per_instance, float(finite.sum()))
    return Estimate(rate, *wilson_interval(min(rate * trials, trials), trials))
