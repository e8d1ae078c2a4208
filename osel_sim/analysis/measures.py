"""What a replay's choices came to: rewards with intervals, share of the learnable gap, regret, differences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate, instance_draws, over_instances
from osel_sim.analysis.gains import Gain, ahead_of, gain_of
from osel_sim.analysis.log import Array, LoggedOutcomes
from osel_sim.analysis.oracles import Oracles
from osel_sim.analysis.outcomes import PolicyResult, overall
from osel_sim.formats.replay_result import Choices
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.intervals import RESAMPLES, Interval, bootstrap_mean_interval, bootstrap_means

UNBEATABLE = ("hindsight", "best_single")
"""What needs no check: nobody earns more than the one, and to pass the other is what selectors are for."""

LATE = 0.25
"""The share of a stream's decisions that counts as late."""


@dataclass(frozen=True)
class Curves:
    """What was received and what could have been, in every decision of every seed, (S, T).

    Attributes:
        selectors: name -> reward.
        oracles: hindsight, expected (where there are repeats), predictable, per_task, best_single -> reward; less those that are `beaten`.
        learnable: which oracle bounds what can be learned; None where those that could are beaten.
        late: first decision of the late part.
        expected_errors: how far the mean of the expected oracle may be off, as it was measured on the instances with repeats: bootstrap draws,
            (RESAMPLES,); zeros without repeats.
        gains: oracle -> what it has over the best single policy.
        beaten: oracle -> selector that earned more than it, beyond the error of the difference, over the whole stream or its last quarter. What is
            beaten is no bound of anything.
    """

    selectors: dict[str, Array]
    oracles: dict[str, Array]
    learnable: str | None
    late: int
    expected_errors: Array
    gains: Mapping[str, Gain]
    beaten: Mapping[str, str]

    def errors(self, oracle: str) -> Array:
        """How far the mean of an oracle may be off, (RESAMPLES,): only the expected one is an estimate."""
        return self.expected_errors if oracle == "expected" else np.zeros(RESAMPLES)

    def interval(self, oracle: str, values: Array) -> Interval:
        """95 % bootstrap interval of the mean of values (S, T) that an oracle's rewards went into: over seeds and what the oracle may be off."""
        low, high = np.quantile(bootstrap_means(units(values)) + self.errors(oracle), [0.025, 0.975])
        return float(low), float(high)


def curves(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, best: Oracles) -> Curves:
    """Rewards decision by decision.

    Args:
        log: the instances of `choices`, in its order.
        best: of the same log and weights.
    """
    table = log.rewards(weights)
    outcomes = choices.outcomes(table)
    tasks = best.per_task[choices.order][:, :, None]
    found = {
        "hindsight": outcomes.max(axis=2),
        **({} if best.expected is None else {"expected": best.expected[choices.order]}),
        "predictable": best.predictable[choices.order],
        "per_task": np.take_along_axis(outcomes, tasks, axis=2)[:, :, 0],
        "best_single": outcomes[:, :, best.best_single],
    }
    decisions = choices.order.shape[1]
    received = {name: choices.received(name, table) for name in choices.chosen}
    gains = best.expected_gains
    errors = bootstrap_means(gains, seed=1) - gains.mean() if len(gains) else np.zeros(RESAMPLES)  # another seed than that of the streams' resampling
    off = {"expected": float(errors.std())}
    late = decisions - max(1, int(decisions * LATE))
    over = {name: gain_of(choices.order, values - found["best_single"], off.get(name, 0.0)) for name, values in found.items()}
    ahead = {name: ahead_of(values, received, choices.order, late, off.get(name, 0.0)) for name, values in found.items() if name not in UNBEATABLE}
    beaten = {name: selector for name, selector in ahead.items() if selector is not None}
    bounds = [name for name in (best.learnable, "predictable") if name not in beaten]
    kept = {name: values for name, values in found.items() if name not in beaten}
    return Curves(received, kept, bounds[0] if bounds else None, late, errors, over, beaten)


def units(values: Array) -> Array:
    """What is drawn anew for an interval of the mean of values (S, T): the seeds' means; of a single seed its decisions."""
    return np.asarray(values.mean(axis=1) if len(values) > 1 else values[0], np.float64)


def measure_selector(log: LoggedOutcomes, choices: Choices, rewards: Curves, name: str) -> dict[str, Any]:
    """One selector: what `replay.json` says about it under `selectors`."""
    received = rewards.selectors[name]
    of_each = {"success": log.success, "subgoals": log.subgoals, "score": log.score, "steps": log.steps, "seconds": log.seconds, "price": log.price}
    got = {what: _mean(choices.received(name, values)) for what, values in of_each.items()}
    chosen = choices.chosen[name]
    late = slice(rewards.late, None)
    successes = choices.received(name, log.success)
    return {
        "mean_reward": float(received.mean()),
        **_with_interval("ci95", over_instances(received, choices.order)),
        "mean_reward_late": float(received[:, late].mean()),
        "success_rate": got["success"],
        **_with_interval("success_ci95", over_instances(successes, choices.order)),
        "mean_subgoals": got["subgoals"],
        "mean_score": got["score"],
        "mean_steps": got["steps"],
        "mean_seconds": got["seconds"],
        "mean_price": got["price"],
        "shares": {policy: float((chosen == column).mean()) for column, policy in enumerate(choices.policies)},
        "shares_late": {policy: float((chosen[:, late] == column).mean()) for column, policy in enumerate(choices.policies)},
        **_gap_entries("learnable_gap_closed", gap_closed(received, rewards, rewards.learnable, 0)),
        **_gap_entries("learnable_gap_closed_late", gap_closed(received, rewards, rewards.learnable, rewards.late)),
        **_gap_entries("predictable_gap_closed", gap_closed(received, rewards, "predictable", 0)),
        **_gap_entries("predictable_gap_closed_late", gap_closed(received, rewards, "predictable", rewards.late)),
        "regret": {oracle: float((values - received).mean()) for oracle, values in rewards.oracles.items()},
        "regret_ci95": {oracle: list(rewards.interval(oracle, values - received)) for oracle, values in rewards.oracles.items()},
        "decisions_until_ahead": until_ahead(received - rewards.oracles["best_single"]),
        "decisions_until_better": until_better(received - rewards.oracles["best_single"]),
    }


def measure_fixed(log: LoggedOutcomes, weights: RewardWeights) -> dict[str, dict[str, Any]]:
    """What always one policy comes to: over all repeats of all instances, not those that the streams happened to draw.

    Returns:
        policy -> those of a selector's measures (`measure_selector`) of which a log says more than its streams.
    """
    return {result.policy: _fixed(result) for result in overall(log, weights)}


def _fixed(result: PolicyResult) -> dict[str, Any]:
    names = {"success_rate": "success", "mean_subgoals": "subgoals", "mean_score": "score", "mean_steps": "steps", "mean_seconds": "seconds"}
    means = {key: getattr(result, name) for key, name in (names | {"mean_reward": "reward", "mean_price": "price"}).items()}
    found = {key: None if mean is None else mean.value for key, mean in means.items()}
    return found | _with_interval("ci95", result.reward) | _with_interval("success_ci95", result.success)


def oracle_interval(rewards: Curves, oracle: str, instances: NDArray[Any]) -> Interval:
    """95 % bootstrap interval of an oracle's mean reward: over instances (S, T), and what the oracle may be off."""
    draws = instance_draws(rewards.oracles[oracle].ravel(), instances.ravel(), RESAMPLES) + rewards.errors(oracle)
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)


def gap_closed(received: Array, rewards: Curves, oracle: str | None, first: int) -> tuple[float, Interval] | None:
    """Share of the gap to an oracle closed from decision `first` on, with its 95 % bootstrap interval over seeds and, for the expected oracle, over
    the instances with repeats that it was measured on.

    (selector - best single) / (oracle - best single), all averaged over seeds and decisions. None where the oracle is not better than the best
    single policy beyond its error, so that there is no gap to share, or is no bound because a selector beat it.
    """
    if oracle not in rewards.oracles or not rewards.gains[oracle].beyond_error():
        return None
    base = rewards.oracles["best_single"][:, first:]
    gains, gaps = units(received[:, first:] - base), units(rewards.oracles[oracle][:, first:] - base)
    if gaps.mean() <= 0.0:
        return None
    share = float(gains.mean() / gaps.mean())
    # The same seed draws the same units for both.
    above, below = bootstrap_means(gains), bootstrap_means(gaps) + rewards.errors(oracle)
    low, high = np.quantile(above[below > 0.0] / below[below > 0.0], [0.025, 0.975])
    return share, (float(low), float(high))


def until_ahead(differences: Array) -> int | None:
    """After how many decisions the sum of the differences (S, T), averaged over seeds, is positive and stays so; None: not at the end."""
    total = differences.mean(axis=0).cumsum()
    behind = np.flatnonzero(total <= 0.0)
    if not len(behind):
        return 1
    return None if behind[-1] == len(total) - 1 else int(behind[-1]) + 2


def until_better(differences: Array) -> int | None:
    """After how many decisions the sum of the differences (S, T), averaged over seeds, is lowest: later ones win more than they lose."""
    # At the end it has not begun to win yet.
    total = np.concatenate([[0.0], differences.mean(axis=0).cumsum()])
    lowest = int(total.argmin())
    return None if lowest == len(total) - 1 else lowest


def paired(rewards: Curves, names: Sequence[str]) -> list[dict[str, Any]]:
    """Mean differences in reward between any two selectors on the same streams, with bootstrap intervals over seeds."""
    result = []
    for index, one in enumerate(names):
        for other in names[index + 1 :]:
            apart = rewards.selectors[one] - rewards.selectors[other]
            difference, late = units(apart), units(apart[:, rewards.late :])
            result.append(
                {
                    "a": one,
                    "b": other,
                    "difference": float(difference.mean()),
                    "ci95": list(bootstrap_mean_interval(difference)),
                    "difference_late": float(late.mean()),
                    "ci95_late": list(bootstrap_mean_interval(late)),
                }
            )
    return result


def _with_interval(name: str, estimate: Estimate | None) -> dict[str, Any]:
    return {name: None if estimate is None else [estimate.low, estimate.high]}


def _gap_entries(name: str, found: tuple[float, Interval] | None) -> dict[str, Any]:
    share, interval = found or (None, None)
    return {name: share, f"{name}_ci95": None if interval is None else list(interval)}


def _mean(values: Array) -> float | None:
    """Mean of what is known; None where nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None
