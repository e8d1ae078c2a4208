"""Where routing is trivial: which policies the clusters want, over all weights of time and price (paper, section IV, end)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.offline.clusters import complete_instances, score_of, time_of
from osel_sim.offline.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.selection.reward import RewardWeights

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
    """Along one weight, the other kept: routing is trivial in these ranges, and worth something between them.

    Attributes:
        axis: the weight that moves.
        all_remote_below: below it every cluster wants a remote policy; None: never.
        all_local_above: above it every cluster wants a local one; None: not within what was looked at.
        limit: up to where it was looked.
    """

    axis: Axis
    all_remote_below: float | None
    all_local_above: float | None
    limit: float


@dataclass(frozen=True)
class _Means:
    """Means of each cluster (C, P), and the clusters' shares (C,)."""

    shares: Array
    score: Array
    time: Array
    price: Array

    def remote_share(self, alpha_time: float, alpha_price: float, remote: NDArray[np.bool_]) -> float:
        return float(self.shares[remote[self._rewards(alpha_time, alpha_price).argmax(axis=1)]].sum())

    def gain(self, alpha_time: float, alpha_price: float) -> float:
        rewards = self._rewards(alpha_time, alpha_price)
        return float(self.shares @ rewards.max(axis=1) - (self.shares @ rewards).max())

    def _rewards(self, alpha_time: float, alpha_price: float) -> Array:
        return np.asarray(self.score - alpha_time * self.time - alpha_price * self.price, np.float64)


def weights_map(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_]) -> WeightsMap:
    """The map around the weights given, three decades of each.

    Args:
        labels: (N,) cluster of each instance.
        weights: where the user stands; always within the map.
        remote: (P,) which policies are remote.
    """
    means = _means(log, labels, weights)
    time_high, price_high = _ends(means, weights)
    times, prices = (np.geomspace(high / 10**_DECADES, high, _CELLS) for high in (time_high, price_high))
    share = [[means.remote_share(time, price, remote) for time in times.tolist()] for price in prices.tolist()]
    gain = [[means.gain(time, price) for time in times.tolist()] for price in prices.tolist()]
    return WeightsMap(times, prices, np.array(share), np.array(gain))


def trivial_ranges(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, remote: NDArray[np.bool_]) -> list[TrivialRange]:
    """For each weight, with the other as given, where all clusters agree. Looked at from 0 up, in steps of 2% from a thousandth of the end."""
    means = _means(log, labels, weights)
    ranges = []
    for axis, high in zip(AXES, _ends(means, weights), strict=True):
        looked = np.concatenate([[0.0], np.geomspace(high / 1_000, high, 350)])
        at = [moved(weights, axis, float(value)) for value in looked]
        share = np.array([means.remote_share(point.alpha_time, point.alpha_price, remote) for point in at])
        remote_until, local_from = _leading(share > 1.0 - 1e-9), _leading((share < 1e-9)[::-1])
        ranges.append(
            TrivialRange(
                axis,
                float(looked[remote_until - 1]) if remote_until else None,
                float(looked[len(looked) - local_from]) if local_from else None,
                float(high),
            )
        )
    return ranges


def limits(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights) -> dict[Axis, float]:
    """Up to where the map, the ranges and the frontier look along each weight.

    Args:
        labels: (N,) cluster of each instance.
    """
    return dict(zip(AXES, _ends(_means(log, labels, weights), weights), strict=True))


def moved(weights: RewardWeights, axis: Axis, value: float) -> RewardWeights:
    """The weights with another value of one of them."""
    return replace(weights, alpha_time=value) if axis == "alpha_time" else replace(weights, alpha_price=value)


def _means(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights) -> _Means:
    complete = complete_instances(log, weights)
    numbers = np.unique(labels[complete])
    score = mean_over_repeats(score_of(log, weights))
    tables = (score, time_of(log, weights), np.nan_to_num(mean_over_repeats(log.price)))
    members = [complete & (labels == number) for number in numbers]
    shares = np.array([rows.sum() / complete.sum() for rows in members])
    return _Means(shares, *(np.stack([table[rows].mean(axis=0) for rows in members]) for table in tables))


def _ends(means: _Means, weights: RewardWeights) -> tuple[float, float]:
    """Where the map ends: weights at which time, or price, weighs three successes, but ten to a hundred times those given where they are not zero."""

    def end(table: Array, given: float) -> float:
        differences = np.abs(table[:, :, None] - table[:, None, :])
        mean = float(differences.max(axis=(1, 2)).mean())
        settled = 3.0 / mean if mean > 1e-9 else 1.0
        return settled if given == 0.0 else min(max(settled, 10.0 * given), 100.0 * given)

    return end(means.time, weights.alpha_time), end(means.price, weights.alpha_price)


def _leading(flags: NDArray[np.bool_]) -> int:
    """How many are true before the first that is not."""
    return len(flags) if flags.all() else int(np.argmin(flags))
