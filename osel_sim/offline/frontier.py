"""Success against seconds and against price as one weight sweeps from nothing to where it settles everything."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.offline.clusters import complete_instances
from osel_sim.offline.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.offline.weights_map import Axis, moved
from osel_sim.selection.reward import RewardWeights

_POINTS = 49
_REPLAYED = 9
"""Weights at which a selector is replayed: a replay takes seconds where an oracle takes none."""

Chooser = Callable[[Array], NDArray[np.int64]]
"""Of rewards (N, P): the column chosen for each instance, (N,)."""


@dataclass(frozen=True)
class Frontier:
    """What a way of choosing comes to at each weight.

    Attributes:
        name: `hindsight oracle`, or `best policy of each cluster`.
        weights: (K,) the weight that sweeps; the other is as given.
        success, seconds, price: (K,) means over the instances.
    """

    name: str
    weights: Array
    success: Array
    seconds: Array
    price: Array


def frontiers(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, sweep: Axis, high: float) -> list[Frontier]:
    """Frontiers of the hindsight oracle and of the best policy of each cluster.

    The cluster's policy is chosen on the half of the instances that the one at hand is not in; what it comes to is then what one could have had. It
    stands for a selector that has learnt all that the clusters tell. Selectors that learn are replayed at each weight (`selector_frontier`).

    Args:
        labels: (N,) cluster of each instance.
        sweep: which weight.
        high: up to where, from a ten-thousandth of it, and 0.
    """
    part = log.take(complete_instances(log, weights))
    own, first = labels[complete_instances(log, weights)], part.half("choose")
    swept = np.concatenate([[0.0], np.geomspace(high / 10_000, high, _POINTS - 1)])
    tables = [mean_over_repeats(values) for values in (part.success, part.seconds, part.price)]
    choosers: dict[str, Chooser] = {"hindsight oracle": lambda rewards: rewards.argmax(axis=1)}
    if first.any() and not first.all():
        choosers["best policy of each cluster"] = lambda rewards: _by_cluster(rewards, own, first)
    found = []
    for name, choose in choosers.items():
        columns = [choose(part.mean_rewards(moved(weights, sweep, float(value)))) for value in swept]
        rows = np.arange(len(part))
        found.append(Frontier(name, swept, *(np.array([_mean(table[rows, chosen]) for chosen in columns]) for table in tables)))
    return found


def selector_frontier(log: LoggedOutcomes, weights: RewardWeights, selector: str, sweep: Axis, high: float, told: bool, seeds: int = 2) -> Frontier:
    """Frontier of a selector that learns, replayed anew at each of a few weights: means over the last quarter of its streams.

    Args:
        log: complete instances only. Its skills, if it has any, are told.
        told: whether a selector that takes expected costs is told those of the log.
        seeds: streams at each weight; of 1,000 decisions at most.
    """
    from osel_sim.offline.engine import replay
    from osel_sim.selection.registry import wanted_of

    swept = np.concatenate([[0.0], np.geomspace(high / 300, high, _REPLAYED - 1)])
    decisions = min(len(log), 1_000)
    late = slice(decisions * 3 // 4, None)
    found = []
    for value in swept:
        here = moved(weights, sweep, float(value))
        known: dict[str, Any] = {"skills": log.skills} | ({"expected_costs": log.expected_costs(here)} if told else {})
        choices = replay(log, here, [selector], range(seeds), decisions, settings={selector: wanted_of(selector, known)})
        found.append([_mean(choices.received(selector, table)[:, late]) for table in (log.success, log.seconds, log.price)])
    success, seconds, price = np.array(found).T
    return Frontier(selector, swept, success, seconds, price)


def _by_cluster(rewards: Array, labels: NDArray[np.int64], first: NDArray[np.bool_]) -> NDArray[np.int64]:
    chosen = np.empty(len(rewards), np.int64)
    for choosing in (first, ~first):
        overall = int(rewards[choosing].mean(axis=0).argmax())
        for number in np.unique(labels):
            known = choosing & (labels == number)
            chosen[~choosing & (labels == number)] = int(rewards[known].mean(axis=0).argmax()) if known.any() else overall
    return chosen


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")
