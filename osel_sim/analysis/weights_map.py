"""Where routing is trivial: which policies the clusters want, over all weights of time and price (paper, section IV, end)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.clusters import complete_rows, score_of, time_of
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.outcomes import rates_of
from osel_sim.core.errors import DataError
from osel_sim.selection.reward import RewardWeights, charge, combined

Axis = Literal["alpha_time", "alpha_price"]
AXES: tuple[Axis, Axis] = ("alpha_time", "alpha_price")

_CELLS = 61
_DECADES = 3.0


@dataclass(frozen=True)
class WeightsMap:
    """What the best policy of each cluster is at each pair of weights. Means are exact: the reward is linear in the weights.

    Attributes:
        alpha_time: (X,); alpha_price: (Y,), both rising by a constant factor.
        remote_share: (Y, X) share of the instances whose cluster is best served by a remote policy: 0 all local, 1 all remote: routing is trivial.
        gain: (Y, X) contextual minus non-contextual converged reward, chosen and scored on the same instances.
    """

    alpha_time: Array
    alpha_price: Array
    remote_share: Array
    gain: Array


@dataclass(frozen=True)
class TrivialRange:
    """Along one weight, the other kept: where all clusters agree.

    Attributes:
        axis: the weight that moves.
        all_remote_below: below it every cluster wants a remote policy; None: never.
        all_local_above: above it every cluster wants a local one; None: not within what was looked at.
        paper_all_remote_below, paper_all_local_above: the same by the paper's formula.
        one_policy: (policy, low, high) where one and the same policy is best in every cluster, so that there is nothing to route. With several
            remote (or local) policies that is less than where all are remote (or local).
        limit: up to where it was looked.
    """

    axis: Axis
    all_remote_below: float | None
    all_local_above: float | None
    paper_all_remote_below: float | None
    paper_all_local_above: float | None
    one_policy: list[tuple[str, float, float]]
    limit: float


@dataclass(frozen=True)
class Swept:
    """What of a log can be looked at over the weights.

    Attributes:
        axes: weights that something in the log hangs on: alpha_time where it has times, alpha_price where it has prices.
        rows: bool (N,), instances on which every policy has an outcome with all that those weights ask for.
    """

    axes: tuple[Axis, ...]
    rows: NDArray[np.bool_]


def swept(log: LoggedOutcomes, weights: RewardWeights) -> Swept:
    """Which weights can be moved, and on which instances: a time or a price that is not known is not none.

    Raises:
        DataError: no instance has an outcome of every policy at the weights given.
    """
    rows = complete_rows(log, weights)
    axes: list[Axis] = []
    for axis in AXES:
        try:
            also = rows & complete_rows(log, moved(weights, axis, 1.0))
        except DataError:
            continue
        if also.any():
            axes, rows = [*axes, axis], also
    return Swept(tuple(axes), rows)


@dataclass(frozen=True)
class _Means:
    """Means of each cluster (C, P), and the clusters' shares (C,)."""

    shares: Array
    score: Array
    time: Array
    price: Array

    def best(self, alpha_time: float, alpha_price: float) -> NDArray[np.int64]:
        """Column of the best policy of each cluster, (C,)."""
        return self._rewards(alpha_time, alpha_price).argmax(axis=1)

    def remote_share(self, alpha_time: float, alpha_price: float, remote: NDArray[np.bool_]) -> float:
        return float(self.shares[remote[self.best(alpha_time, alpha_price)]].sum())

    def gain(self, alpha_time: float, alpha_price: float) -> float:
        rewards = self._rewards(alpha_time, alpha_price)
        return float(self.shares @ rewards.max(axis=1) - (self.shares @ rewards).max())

    def _rewards(self, alpha_time: float, alpha_price: float) -> Array:
        return combined(RewardWeights(alpha_time, alpha_price), self.score, self.time, self.price)


def weights_map(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_]) -> WeightsMap | None:
    """The map around the weights given, three decades of each; None where the log lacks times or prices.

    Args:
        labels: (N,) cluster of each instance.
        weights: where the user stands; always within the map.
        remote: (P,) which policies are remote.
    """
    part = swept(log, weights)
    if len(part.axes) < len(AXES):
        return None
    means = _means(log, labels, weights, part)
    time_high, price_high = _ends(means, weights)
    times, prices = (np.geomspace(high / 10**_DECADES, high, _CELLS) for high in (time_high, price_high))
    share = [[means.remote_share(time, price, remote) for time in times.tolist()] for price in prices.tolist()]
    gain = [[means.gain(time, price) for time in times.tolist()] for price in prices.tolist()]
    return WeightsMap(times, prices, np.array(share), np.array(gain))


def trivial_ranges(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_]) -> list[TrivialRange]:
    """For each weight that can be moved, with the other as given, where all clusters agree. Looked at from 0 up, in steps of 2% from a thousandth of
    the end.
    """
    part = swept(log, weights)
    means, paper = _means(log, labels, weights, part), _Paper(log.take(part.rows), labels[part.rows], weights, remote, part.axes)
    ranges = []
    for axis, high in limits(log, labels, weights).items():
        looked = np.concatenate([[0.0], np.geomspace(high / 1_000, high, 350)])
        at = [moved(weights, axis, float(value)) for value in looked]
        best = np.array([means.best(point.alpha_time, point.alpha_price) for point in at])
        by_paper = np.array([paper.remote_best(point) for point in at])
        below, above = _agreed(looked, remote[best])
        paper_below, paper_above = _agreed(looked, by_paper)
        alone = np.where((best == best[:, :1]).all(axis=1), best[:, 0], -1)
        ranges.append(TrivialRange(axis, below, above, paper_below, paper_above, _runs(looked, alone, log.policies), float(high)))
    return ranges


def limits(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights) -> dict[Axis, float]:
    """Up to where the map, the ranges and the frontier look along each weight that can be moved.

    Args:
        labels: (N,) cluster of each instance.
    """
    part = swept(log, weights)
    ends = dict(zip(AXES, _ends(_means(log, labels, weights, part), weights), strict=True))
    return {axis: ends[axis] for axis in part.axes}


def moved(weights: RewardWeights, axis: Axis, value: float) -> RewardWeights:
    """The weights with another value of one of them."""
    return replace(weights, alpha_time=value) if axis == "alpha_time" else replace(weights, alpha_price=value)


class _Paper:
    """Equation 5 of the paper for every cluster at any weights: 1 - p_FS against p_FS - alpha_time tau - alpha_price p.

    Args:
        log: instances that have everything. labels: (N,) their clusters. axes: weights that can be moved.
    """

    def __init__(
        self, log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_], axes: Sequence[Axis]
    ) -> None:
        self._members = [labels == number for number in np.unique(labels)]
        self._only_remote = np.array([rates_of("", log.success[rows], remote).only_remote.value for rows in self._members])
        self._score, self._time, self._price = (table[:, remote] for table in _tables(log, weights, axes))

    def remote_best(self, weights: RewardWeights) -> NDArray[np.bool_]:
        """Which clusters (C,) the paper gives to the remote side; of several remote policies the one with the highest reward on each instance."""
        penalties = charge(weights, self._time, self._price)
        merged = np.take_along_axis(penalties, (self._score - penalties).argmax(axis=1)[:, None], axis=1)[:, 0]
        return np.array([1.0 - rate < rate - merged[rows].mean() for rate, rows in zip(self._only_remote, self._members, strict=True)])


def _tables(log: LoggedOutcomes, weights: RewardWeights, axes: Sequence[Axis]) -> tuple[Array, Array, Array]:
    """Score, time and price of every policy on every instance, (N, P) each; 0 for what the log does not have."""
    nothing = np.zeros(log.success.shape[:2])
    time = time_of(log, weights) if "alpha_time" in axes else nothing
    price = mean_over_repeats(log.price) if "alpha_price" in axes else nothing
    return mean_over_repeats(score_of(log, weights)), time, price


def _means(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, part: Swept) -> _Means:
    numbers = np.unique(labels[part.rows])
    members = [part.rows & (labels == number) for number in numbers]
    shares = np.array([rows.sum() / part.rows.sum() for rows in members])
    return _Means(shares, *(np.stack([table[rows].mean(axis=0) for rows in members]) for table in _tables(log, weights, part.axes)))


def _ends(means: _Means, weights: RewardWeights) -> tuple[float, float]:
    """Where the map ends: weights at which time, or price, weighs three successes, but ten to a hundred times those given where they are not zero."""

    def end(table: Array, given: float) -> float:
        differences = np.abs(table[:, :, None] - table[:, None, :])
        mean = float(differences.max(axis=(1, 2)).mean())
        settled = 3.0 / mean if mean > 1e-9 else 1.0
        return settled if given == 0.0 else min(max(settled, 10.0 * given), 100.0 * given)

    return end(means.time, weights.alpha_time), end(means.price, weights.alpha_price)


def _agreed(looked: Array, remote: NDArray[np.bool_]) -> tuple[float | None, float | None]:
    """Up to where all clusters (K, C) are remote, and from where on all are local."""
    first, last = _leading(remote.all(axis=1)), _leading((~remote).all(axis=1)[::-1])
    return float(looked[first - 1]) if first else None, float(looked[len(looked) - last]) if last else None


def _runs(looked: Array, alone: NDArray[np.int64], policies: Sequence[str]) -> list[tuple[str, float, float]]:
    """Stretches of one policy: column (K,), -1 for none."""
    starts = [0, *(np.flatnonzero(np.diff(alone)) + 1).tolist(), len(alone)]
    return [(policies[alone[low]], float(looked[low]), float(looked[high - 1])) for low, high in pairwise(starts) if alone[low] >= 0]


def _leading(flags: NDArray[np.bool_]) -> int:
    """How many are true before the first that is not."""
    return len(flags) if flags.all() else int(np.argmin(flags))
