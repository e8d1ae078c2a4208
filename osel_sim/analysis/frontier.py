"""Success against seconds and against price as one weight sweeps from nothing to where it settles everything."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.clusters import find_clusters, score_of
from osel_sim.analysis.cross_fit import best_of_group, cross_fit
from osel_sim.analysis.engine import Part, Setup
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.weights_map import Axis, limits, moved, swept
from osel_sim.formats.replay_result import Choices
from osel_sim.selection.reward import RewardWeights

_POINTS = 49
_REPLAYED = 6
"""Weights at which selectors are replayed: a replay takes seconds where an oracle takes none."""
_DECISIONS = 1_000
_SEEDS_FOR_EACH = 20

Chooser = Callable[[Array], NDArray[np.int64]]
"""Of rewards (N, P): the column chosen for each instance, (N,)."""


@dataclass(frozen=True)
class Frontier:
    """What a way of choosing comes to at each weight.

    Attributes:
        name: `hindsight oracle`, or `best policy of each cluster`.
        weights: (K,) the weight that sweeps; the other is as given.
        means: what `measured` names -> (K,) means over the instances.
    """

    name: str
    weights: Array
    means: dict[str, Array]


def measured(log: LoggedOutcomes, weights: RewardWeights) -> dict[str, Array]:
    """What a frontier shows of every episode, (N, P, R) each: `score` (what the reward counts as success), `seconds` or `steps`, and `price`."""
    time = {"steps": log.steps} if weights.clock == "steps" else {"seconds": log.seconds}
    return {"score": score_of(log, weights), **time, "price": log.price}


def frontiers(log: LoggedOutcomes, labels: NDArray[np.int64], weights: RewardWeights, sweep: Axis, high: float) -> list[Frontier]:
    """Frontiers of the hindsight oracle and of the best policy of each cluster.

    The cluster's policy is chosen on the half of the instances that the one at hand is not in; what it comes to is then what one could have had. It
    stands for a selector that has learnt all that the clusters tell. Selectors that learn are replayed at each weight (`plan_frontiers`).

    Args:
        labels: (N,) cluster of each instance.
        sweep: which weight.
        high: up to where, from a ten-thousandth of it, and 0.
    """
    rows = swept(log, weights).rows
    part, own = log.take(rows), labels[rows]
    first = part.first_half()
    values = np.concatenate([[0.0], np.geomspace(high / 10_000, high, _POINTS - 1)])
    tables = {key: mean_over_repeats(table) for key, table in measured(part, weights).items()}
    choosers: dict[str, Chooser] = {"hindsight oracle": lambda rewards: rewards.argmax(axis=1)}
    if first.any() and not first.all():
        choosers["best policy of each cluster"] = lambda rewards: cross_fit(first, lambda by, on: best_of_group(rewards, own, by, on))
    found = []
    for name, choose in choosers.items():
        columns = [choose(part.mean_rewards(moved(weights, sweep, float(value)))) for value in values]
        every = np.arange(len(part))
        means = {key: np.array([_mean(table[every, chosen]) for chosen in columns]) for key, table in tables.items()}
        found.append(Frontier(name, values, means))
    return found


@dataclass(frozen=True)
class FrontierPlan:
    """What to replay for the frontiers of selectors that learn, and what to make of it.

    Attributes:
        part: each of a few weights is a setup of it, those of one axis after those of the other.
        values: axis -> its weights, from 0.
        labels: (N,) cluster of each of the part's instances.
        tables: as `measured` gives them.
    """

    part: Part
    values: dict[Axis, Array]
    labels: NDArray[np.int64]
    tables: dict[str, Array]

    def frontiers(self, choices: Sequence[Choices]) -> dict[str, Any]:
        """Means over the last quarter of the streams.

        A few streams end in other instances than the log is made of, and long tasks among them would move a whole line. So every cluster counts by
        its share of the log (post-stratification), which takes three quarters of that away from the seconds of auto on the shipped log.

        Args:
            choices: what came of `part`.

        Returns:
            seeds, decisions, and of each weight that can be moved: weights [K] from 0, selectors {name: means as `measured` names them}, [K] each,
            None where unknown.
        """
        length = choices[0].order.shape[1] if choices else 0
        late, left = slice(length * 3 // 4, None), iter(choices)
        found: dict[str, Any] = {"seeds": len(self.part.seeds), "decisions": self.part.decisions}
        for axis, values in self.values.items():
            own = [next(left) for _ in values]
            found[axis] = {
                "weights": values.tolist(),
                "selectors": {
                    selector: {
                        name: [_known(_weighted(one.received(selector, table)[:, late], self.labels[one.order[:, late]], self.labels)) for one in own]
                        for name, table in self.tables.items()
                    }
                    for selector in self.part.selectors
                },
            }
        return found


def plan_frontiers(
    log: LoggedOutcomes,
    setup: Callable[[RewardWeights], Setup],
    weights: RewardWeights,
    selectors: Sequence[str],
    seeds: int,
    decisions: int | None,
) -> FrontierPlan:
    """Plan to replay selectors anew at each of a few weights.

    Args:
        log: complete instances only.
        setup: under what to replay at other weights.
        weights: in the middle.
        seeds, decisions: of the replay that this goes with; one in twenty of the seeds and 1,000 decisions at most are replayed at each weight.

    Raises:
        DataError: there are too few instances for clusters, which say up to where to look.
    """
    labels, rows = find_clusters(log.contexts).labels, swept(log, weights).rows
    ends, part = limits(log, labels, weights), log.take(rows)
    values = {axis: np.concatenate([[0.0], np.geomspace(high / 300, high, _REPLAYED - 1)]) for axis, high in ends.items()}
    setups = [setup(moved(weights, axis, float(value))) for axis in values for value in values[axis]]
    length = min(len(part), _DECISIONS, decisions or _DECISIONS)
    streams = range(max(1, seeds // _SEEDS_FOR_EACH))
    return FrontierPlan(Part(part, setups, selectors, streams, length), values, labels[rows], measured(part, weights))


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def _weighted(values: Array, clusters: NDArray[np.int64], everywhere: NDArray[np.int64]) -> float:
    """Mean of values (S, T) of instances of these clusters (S, T), each cluster by its share everywhere (N,); of those it has values of."""
    known = np.isfinite(values)
    numbers, shares = np.unique(everywhere, return_counts=True)
    means = np.array([_mean(values[known & (clusters == number)]) for number in numbers])
    found = np.isfinite(means)
    return float(np.average(means[found], weights=shares[found])) if found.any() else float("nan")


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None
