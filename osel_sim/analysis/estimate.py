"""A number with its 95% interval, and how to get one."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.statistics.clustered import unit_mean
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


def mean_of(values: ArrayLike, units: "NDArray[np.int64] | None" = None) -> Estimate | None:
    """Mean of what is not NaN with its interval; None of nothing.

    Args:
        values: (n,).
        units: (n,) number of the unit that each is of, such as a scene that instances share; None: each is a unit. The interval is over units:
            a bootstrap where each has one value, else that of a mean of clustered values.
    """
    sample = np.asarray(values, np.float64).ravel()
    known = np.isfinite(sample)
    if not known.any():
        return None
    if units is not None and len(set(units[known].tolist())) < known.sum():
        found = unit_mean(np.bincount(units[known], weights=sample[known]), np.bincount(units[known]))
        return Estimate(found.mean, *found.interval()) if found.units > 1 else Estimate(found.mean, found.mean, found.mean)
    sample = sample[known]
    return Estimate(float(sample.mean()), *bootstrap_mean_interval(sample, resamples=RESAMPLES))


def rate_of(outcomes: "Array", units: "NDArray[np.int64] | None" = None) -> Estimate | None:
    """Share of successes among the outcomes (N, R) that are not NaN; None of nothing.

    Wilson's interval, with as many trials as the repeats of an instance, which are no independent trials, are worth; with graded outcomes that of a
    mean. The rate is that of the mean instance, so that one with more repeats does not weigh more.

    Args:
        units: (N,) as in `mean_of`: instances of one unit are no independent trials either.
    """
    rows = np.isfinite(outcomes).any(axis=-1)
    known = outcomes[rows]
    if not known.size:
        return None
    finite = np.isfinite(known)
    per_instance = np.nanmean(known, axis=-1)
    if not np.isin(known[finite], (0.0, 1.0)).all():
        return mean_of(per_instance, None if units is None else units[rows])
    rate, trials = float(per_instance.mean()), effective_trials(_per_unit(per_instance, None if units is None else units[rows]), float(finite.sum()))
    return Estimate(rate, *wilson_interval(min(rate * trials, trials), trials))


def _per_unit(values: "Array", units: "NDArray[np.int64] | None") -> "Array":
    if units is None:
        return values
    counts = np.bincount(units)
    return np.asarray(np.bincount(units, weights=values)[counts > 0] / counts[counts > 0], np.float64)
