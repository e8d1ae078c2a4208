"""Which of several is best: the probability to be the highest of several Gaussian quantities, and the share of cases in which each one is."""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

TIE = 1e-9
"""Values that differ by no more are equal: the same reward comes out differently in the last bits when it is a mean of other repeats."""

QUANTILES = 32
"""Points of each distribution that the grid begins from, of equal probability between them."""

TAILS = (3.5, 4.5, 6.0)
"""Deviations from the mean that the grid reaches into each tail."""

REACH = 5.0
"""Deviations within which a quantity lies for certain."""

GRID, COARSE = 640, 192
"""Most points of the grid, and most where there are more than `MANY` quantities; of more points evenly spaced ones are kept."""
MANY = 64


def probability_of_best(means: Array, deviations: Array) -> Array:
    """Probability of each of several independent Gaussian quantities to be the highest, (P,), to some thousandths; they sum to 1.

    A quantity is the highest where it lies in a cell of a grid and all others lie below. The grid is made of quantiles of all of them, so that the
    cells are narrow wherever one of the distributions is, whatever the others' widths. As the propensities of a choice that is drawn from them
    they are exact, whatever the error of the integral.

    Args:
        means: (P,).
        deviations: (P,) standard deviations, >= 0. If any is 0, those with the highest mean share the probability.
    """
    if len(means) == 1:
        return np.ones(1)
    if not (deviations > 0.0).all():
        best = means == means.max()
        return np.asarray(best / best.sum(), np.float64)
    from scipy.special import ndtr

    points = (means[:, None] + deviations[:, None] * _quantiles()).ravel()
    points = np.sort(points[points >= (means - REACH * deviations).max()])  # the highest of all lies below that with next to no probability
    most = GRID if len(means) <= MANY else COARSE
    if len(points) > most:
        points = points[np.linspace(0, len(points) - 1, most).astype(np.int64)]
    below = ndtr((points - means[:, None]) / deviations[:, None])  # (P, points)
    logarithms = np.log(np.maximum(below, 1e-300))
    others = np.exp(logarithms.sum(axis=0) - logarithms)  # all others lie below the point
    within = np.diff(below, axis=1, prepend=0.0, append=1.0)
    edges = np.concatenate([np.zeros((len(means), 1)), others, np.ones((len(means), 1))], axis=1)
    probabilities = (within * (edges[:, 1:] + edges[:, :-1])).sum(axis=1)
    return np.asarray(probabilities / probabilities.sum(), np.float64)


def best_of_each(values: ArrayLike) -> NDArray[np.bool_]:
    """Which columns have the highest value of their row, (N, P); several where they are equal within `TIE`, none in a row with a NaN."""
    table = np.asarray(values, np.float64)
    return np.asarray(table >= table.max(axis=1, keepdims=True) - TIE, bool)


def share_of_best(values: ArrayLike) -> Array:
    """Share of the rows of a table (N, P) in which each column has the highest value, (P,), over rows without NaN; NaN if there are none.

    Columns that are equal within `TIE` share their row. Were it counted for the first of them, the figures would depend on the order of the columns,
    and a policy would lead because it is listed first: on easy instances two local policies often come to the same reward.
    """
    best = best_of_each(values)
    best = best[best.any(axis=1)]
    return np.asarray((best / best.sum(axis=1, keepdims=True)).mean(axis=0) if len(best) else np.full(best.shape[1], np.nan), np.float64)


@cache
def _quantiles() -> Array:
    """Where the grid begins from, in deviations from the mean."""
    from scipy.special import ndtri

    middles = ndtri((np.arange(QUANTILES) + 0.5) / QUANTILES)
    return np.concatenate([-np.array(TAILS[::-1]), middles, TAILS])
