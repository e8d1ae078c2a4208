"""A number with its 95% interval, and how to get one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from osel_sim.statistics.intervals import bootstrap_mean_interval, effective_trials, wilson_interval

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
