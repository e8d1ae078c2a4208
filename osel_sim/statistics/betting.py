"""Bounds on a mean that hold although what was measured was learned from while it was measured."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError

BETS = np.geomspace(0.01, 0.8, 12)
"""Sizes of the bets that are made at once, as fractions of the largest allowed."""


def advantage_bounds(differences: ArrayLike, span: float, error: float) -> tuple[float, float]:
    """Lower and upper bound on the mean advantage, each wrong with probability `error` at most.

    In one random order of the instances, decision t's difference has an expected value given all before it: the advantage of the selector as it then
    is. These need not be equal (the selector learns) nor independent. What is bounded is their mean over the decisions, by a betting argument: wagers
    on the difference exceeding its expectation, settled with an empirical Bernstein correction, win on average nothing, so they multiply the stake by
    1 / error with probability `error` at most (Howard et al., 2021, theorem 4; Fan's inequality). Several orders (seeds) of the same instances are no
    independent evidence. Their exponents are averaged, which by Jensen's inequality never exceeds the average of the wagers, whatever binds them
    together: more seeds average out the orders' luck, but the bound never gets narrower than one pass over that many instances allows.

    Args:
        differences: (seeds, decisions) received minus what the other would have received, in the order in which it was learned from.
        span: rewards lie within an interval of this length, so that differences lie in [-span, span]; > 0.
        error: in (0, 1), for each side.

    Raises:
        UsageError: no differences, one that is not finite or beyond `span`, or a number out of range.
    """
    table = np.atleast_2d(np.asarray(differences, np.float64))
    if not table.size or not np.isfinite(table).all():
        raise UsageError(f"bounds need finite differences (seeds, decisions), got shape {table.shape}")
    if not span > 0.0 or np.abs(table).max() > span * (1.0 + 1e-9):
        raise UsageError(f"differences must lie within +-span, got {np.abs(table).max()} and a span of {span}")
    if not 0.0 < error < 1.0:
        raise UsageError(f"error must lie strictly between 0 and 1, got {error}")
    return _lower(table, span, error), -_lower(-table, span, error)


def _lower(table: NDArray[np.float64], span: float, error: float) -> float:
    decisions = table.shape[1]
    # Each difference is predicted by the mean of those before it; what it misses that by cannot be below -2 span.
    before = np.concatenate([np.zeros((len(table), 1)), table.cumsum(axis=1)[:, :-1] / np.arange(1, decisions)], axis=1)
    squares = float(((table - before) ** 2).sum(axis=1).mean())
    total = float(table.sum(axis=1).mean())
    bets = BETS / (2.0 * span)
    penalty = (-np.log1p(-BETS) - BETS) / (2.0 * span) ** 2 * squares

    def wealth(mean: float) -> float:
        """Logarithm of the stake after all wagers, if the mean were this."""
        exponents = bets * (total - decisions * mean) - penalty
        highest = float(exponents.max())
        return highest + math.log(float(np.exp(exponents - highest).mean()))

    low, high = -span, total / decisions
    if wealth(low) < math.log(1.0 / error):
        return -span
    for _ in range(80):
        middle = (low + high) / 2.0
        low, high = (middle, high) if wealth(middle) >= math.log(1.0 / error) else (low, middle)
    return low
