"""A paired comparison that may be looked at again and again, and stopped as soon as the answer is there.

An interval of a fixed number of pairs promises nothing to whoever looks after every ten and stops when it suits: of equal policies one look in twenty
tells a difference, and some look nearly always does. Here one bets, pair by pair, that the mean difference lies above a value (Waudby-Smith and
Ramdas, 2023). If it does not, no way of betting wins on average, and the stake is ever multiplied by 1 / error with probability `error` at most
(Ville, 1939), at whatever look. Several sizes of bets are made side by side, so that small and large differences are found alike.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.statistics.intervals import Interval

Array = NDArray[np.float64]
BETS = np.linspace(0.1, 0.9, 6)
"""Sizes of the bets, as fractions of the largest with which no pair can lose all."""


def log_capital(differences: ArrayLike, below: float) -> Array:
    """Logarithm of the capital, 1 to begin with, of bets that the mean difference lies above a value.

    Where the true mean of the pairs so far is at most `below`, the capital exceeds 1 / error at some look with probability `error` at most. Pairs
    need not be alike: if tasks take turns, the mean over tasks is what counts, at looks after which every task has had as many pairs.

    Args:
        differences: (..., N) in [-1, 1], in the order in which they came.
        below: in (-1, 1).

    Returns:
        (..., N) after each pair.

    Raises:
        UsageError: a number out of range.
    """
    values = _checked(differences)
    if not -1.0 < below < 1.0:
        raise UsageError(f"the value that is bet against must lie in (-1, 1), got {below}")
    # A bet at a time: a table of all of them would be several times as large as what comes in.
    won = np.stack([np.log1p(bet * (values - below) / (1.0 + below)).cumsum(axis=-1) for bet in BETS])
    return _mean_of_logs(won)


def anytime_bounds(differences: ArrayLike, looks: ArrayLike, error: float) -> list[Interval]:
    """Bounds on the mean difference at each look; each side is wrong at any of them with probability `error` at most.

    Args:
        differences: (N,) in [-1, 1], in the order in which they came.
        looks: (L,) how many pairs there were at each, ascending, in [0, N]; see `log_capital` where tasks take turns.
        error: in (0, 1), of each side.

    Returns:
        at each look what all looks so far leave; (-1, 1) before anything is known.

    Raises:
        UsageError: a number out of range.
    """
    values, ends = _checked(differences), np.asarray(looks, np.int64)
    if not 0.0 < error < 1.0:
        raise UsageError(f"error must lie strictly between 0 and 1, got {error}")
    if values.ndim != 1 or ends.ndim != 1 or (ends.size and (ends.min() < 0 or ends.max() > len(values) or (np.diff(ends) < 0).any())):
        raise UsageError(f"looks must be ascending numbers of pairs, {values.size} at most, got {ends.tolist()}")
    low, high = _lower(values, ends, error), -_lower(-values, ends, error)
    return list(zip(np.maximum.accumulate(low).tolist(), np.minimum.accumulate(high).tolist(), strict=True))


def anytime_p(differences: ArrayLike, looks: ArrayLike) -> float:
    """Two-sided p of a mean difference of 0, whatever made one stop at the last of the looks; arguments as `anytime_bounds` takes them."""
    values, ends = _checked(differences), np.asarray(looks, np.int64)
    ends = ends[ends > 0] - 1
    if not ends.size:
        return 1.0
    highest = max(float(log_capital(side, 0.0)[ends].max()) for side in (values, -values))
    return min(1.0, 2.0 * math.exp(-highest))


def pairs_to_tell(differences: ArrayLike, below: float, error: float) -> float:
    """About how many pairs like these it takes until the mean difference is told to lie above a value; infinite where it does not seem to.

    Args:
        differences: (N,) in [-1, 1].
        below: in (-1, 1).
        error: in (0, 1).
    """
    values = _checked(differences)
    growth = max(float(np.log1p(bet * (values - below) / (1.0 + below)).mean()) for bet in BETS)
    # The best of the bets had a share of the stake; about as much is lost on it as on waiting for luck to even out.
    return (math.log(1.0 / error) + math.log(len(BETS)) / 2.0) / growth if growth > 1e-9 else math.inf


def _lower(values: Array, ends: NDArray[np.int64], error: float) -> Array:
    """Lower bound at each look alone, (L,): the highest value that the bets have been won against."""
    kinds, place = np.unique(values, return_inverse=True)
    counts = np.zeros((len(values) + 1, len(kinds)))
    counts[1:] = (place[:, None] == np.arange(len(kinds))).cumsum(axis=0)
    counts = counts[ends]  # (L, K) how often each difference was seen

    def won(below: Array) -> NDArray[np.bool_]:
        each = np.stack([(counts * np.log1p(bet * (kinds - below[:, None]) / (1.0 + below[:, None]))).sum(axis=1) for bet in BETS])
        return np.asarray(_mean_of_logs(each) >= math.log(1.0 / error), bool)

    low, high = np.full(len(ends), -1.0), np.full(len(ends), 1.0)
    known = won(low + 1e-9)
    for _ in range(50):  # the capital falls as the value that is bet against rises
        middle = (low + high) / 2.0
        above = won(np.maximum(middle, -1.0 + 1e-9))
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return np.where(known, low, -1.0)


def _mean_of_logs(logarithms: Array) -> Array:
    """Logarithm of the mean over the first axis of what these are logarithms of."""
    highest = logarithms.max(axis=0)
    return np.asarray(highest + np.log(np.exp(logarithms - highest).mean(axis=0)))


def _checked(differences: ArrayLike) -> Array:
    values = np.asarray(differences, np.float64)
    if not np.isfinite(values).all() or (values.size and np.abs(values).max() > 1.0 + 1e-9):
        raise UsageError("differences of success must be finite and lie in [-1, 1]")
    return np.asarray(np.clip(values, -1.0, 1.0))
