"""Cross-fitting: policies chosen on one half of the instances and scored on the other, both ways round, so that luck does not count as foresight."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.bool_]
"""Which instances, (N,)."""

Decide = Callable[[Rows, Rows], NDArray[Any]]
"""Of the instances `by` and `on`: what the former say about each of the latter, (number of `on`, ...)."""


def cross_fit(first: Rows, decide: Decide) -> NDArray[Any]:
    """What each half of the instances says about the other, (N, ...).

    Args:
        first: (N,) the instances of one half. Where that is none or all of them, as in the log of a run that has just begun, nothing says something
            about all, and all about nothing.
        decide: called for the first half's sake, then for the second's.
    """
    return _cross_fit([first, ~first], decide)


def cross_fit_parts(parts: NDArray[np.int64], decide: Decide) -> NDArray[Any]:
    """What all other parts of the instances say about each, (N, ...).

    Args:
        parts: (N,) number of the part that each instance is in; at least two.
        decide: called for each part's sake, in the order of their numbers.
    """
    return _cross_fit([parts == part for part in np.unique(parts)], decide)


def _cross_fit(parts: Sequence[Rows], decide: Decide) -> NDArray[Any]:
    told = [(on, decide(~on, on)) for on in parts]
    result = np.empty((len(parts[0]), *told[0][1].shape[1:]), told[0][1].dtype)
    for on, values in told:
        result[on] = values
    return result


def best_of_group(rewards: NDArray[np.float64], groups: NDArray[np.int64], by: Rows, on: Rows, prior: float = 0.0) -> NDArray[np.int64]:
    """Column of the policy that is best in the instance's group among the instances `by`, for each instance `on`.

    Args:
        rewards: (N, P). groups: (N,) from 0 on.
        by: not empty.
        prior: a group's mean rewards count as if so many more of its instances had the mean of all: a small group says little. A group without
            instances takes the policy best of all.
    """
    overall = rewards[by].mean(axis=0)
    size = int(groups.max()) + 1
    counts = np.bincount(groups[by], minlength=size)[:, None]
    sums = np.stack([np.bincount(groups[by], weights=column, minlength=size) for column in rewards[by].T], axis=1)
    means = np.where(counts + prior > 0, (sums + prior * overall) / np.maximum(counts + prior, 1e-9), overall)
    return np.asarray(means.argmax(axis=1)[groups[on]], np.int64)
