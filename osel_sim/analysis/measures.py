"""What a replay's choices came to: rewards with intervals, share of the learnable gap, regret, differences."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.gains import ROUNDING, Gain, ahead_of, gain_of
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.oracles import Oracles
from osel_sim.analysis.outcomes import PolicyResult, overall
from osel_sim.analysis.streamed import Streamed, Units, over_units
from osel_sim.analysis.units import units_of
from osel_sim.analysis.verdict import MARGIN, Played, late_from
from osel_sim.formats.replay_result import Choices
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.clustered import UnitMean, unit_mean
from osel_sim.statistics.intervals import Interval, bootstrap_mean_interval

UNBEATABLE = ("hindsight", "best_single")
"""What needs no check: nobody earns more than the one, and to pass the other is what selectors are for."""


@dataclass(frozen=True)
class Curves:
    """What was received and what could have been, in every decision of every seed, (S, T).

    Rewards are means over the repeats of the chosen policy on the instance: a selector learned from one of them, and could as well have had another.

    Attributes:
        selectors: name -> reward.
        oracles: hindsight, expected (where there are repeats), predictable, per_task, best_single -> reward; less those that are `beaten`.
        learnable: which oracle bounds what can be learned; None where those that could are beaten.
        order: instance of every decision.
        units: (N,) of the instances.
        expected_error: standard error of the expected oracle's mean, as it was measured on the instances with repeats; 0 without repeats.
        gains: oracle -> what it has over the best single policy.
        beaten: oracle -> selector that earned more than it, beyond the error of the difference, over the whole stream or its last quarter. What is
            beaten is no bound of anything.
        margin: a smaller gap to an oracle is none to close.
    """

    selectors: dict[str, Array]
    oracles: dict[str, Array]
    learnable: str | None
    order: NDArray[np.int32]
    units: Units
    expected_error: float
    gains: Mapping[str, Gain]
    beaten: Mapping[str, str]
    margin: float = MARGIN

    @property
    def late(self) -> int:
        """First decision of the late part."""
        return late_from(self.order.shape[1])

    def error(self, oracle: str | None) -> float:
        """Standard error of an oracle's mean besides that over units: only the expected one is an estimate."""
        return self.expected_error if oracle == "expected" else 0.0


def curves(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, best: Oracles, margin: float = MARGIN) -> Curves:
    """Rewards decision by decision.

    Args:
        log: the instances of `choices`, in its order.
        best: of the same log and weights.
        margin: a smaller gap to an oracle is none to close.
    """
    table = log.rewards(weights)
    means, units, order = mean_over_repeats(table), units_of(log), choices.order
    found = {
        "hindsight": choices.outcomes(table).max(axis=2),
        **({} if best.expected is None else {"expected": best.expected[order]}),
        "predictable": best.predictable[order],
        "per_task": means[order, best.per_task[order]],
        "best_single": means[order, best.best_single],
    }
    received = {name: means[order, chosen.astype(np.int64)] for name, chosen in choices.chosen.items()}
    off = {"expected": _expected_error(best, units)}
    late = late_from(order.shape[1])
    over = {name: gain_of(order, values - found["best_single"], units, off.get(name, 0.0)) for name, values in found.items()}
    ahead = {name: ahead_of(values, received, order, units, late, off.get(name, 0.0)) for name, values in found.items() if name not in UNBEATABLE}
    beaten = {name: selector for name, selector in ahead.items() if selector is not None}
    bounds = [name for name in (best.learnable, "predictable") if name not in beaten]
    kept = {name: values for name, values in found.items() if name not in beaten}
    return Curves(received, kept, bounds[0] if bounds else None, order, units, off["expected"], over, beaten, margin)


def _expected_error(best: Oracles, units: Units) -> float:
    known = np.isfinite(best.expected_gains)
    if not known.any():
        return 0.0
    found = unit_mean(np.bincount(units[known], weights=best.expected_gains[known]), np.bincount(units[known]))
    return found.error if math.isfinite(found.error) else 0.0


def played(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, best: Oracles) -> Played:
    """What a verdict follows from."""
    return Played(choices.policies, log.mean_rewards(weights), units_of(log), choices.order, choices.chosen, best.routed)


def measure_selector(log: LoggedOutcomes, choices: Choices, rewards: Curves, name: str, table: Array) -> dict[str, Any]:
    """One selector: what `replay.json` says about it under `selectors`.

    Args:
        table: (N, P) rewards, mean over the repeats.
    """
    received = rewards.selectors[name]
    of_each = {"success": log.success, "subgoals": log.subgoals, "score": log.score, "steps": log.steps, "seconds": log.seconds, "price": log.price}
    averaged = {what: mean_over_repeats(values) for what, values in of_each.items()}
    chosen = choices.chosen[name]
    got = {what: _mean(values[choices.order, chosen.astype(np.int64)]) for what, values in averaged.items()}
    late = slice(rewards.late, None)
    streamed = Streamed.of(choices.order, chosen, len(choices.policies))
    success = over_units(
        averaged["success"][choices.order, chosen.astype(np.int64)], choices.order, rewards.units, streamed.learned(averaged["success"])
    )
    learned, learned_late = streamed.learned(table), Streamed.of(choices.order, chosen, len(choices.policies), rewards.late).learned(table)
    return {
        "mean_reward": float(received.mean()),
        "ci95": _ends(over_units(received, choices.order, rewards.units, learned)),
        "orders_ci95": _orders(received),
        "mean_reward_late": float(received[:, late].mean()),
        "success_rate": got["success"],
        "success_ci95": _ends(success, (0.0, 1.0)),
        "mean_subgoals": got["subgoals"],
        "mean_score": got["score"],
        "mean_steps": got["steps"],
        "mean_seconds": got["seconds"],
        "mean_price": got["price"],
        "shares": {policy: float((chosen == column).mean()) for column, policy in enumerate(choices.policies)},
        "shares_late": {policy: float((chosen[:, late] == column).mean()) for column, policy in enumerate(choices.policies)},
        **_gap_entries("learnable_gap_closed", gap_closed(received, rewards, rewards.learnable, 0, learned)),
        **_gap_entries("learnable_gap_closed_late", gap_closed(received, rewards, rewards.learnable, rewards.late, learned_late)),
        **_gap_entries("predictable_gap_closed", gap_closed(received, rewards, "predictable", 0, learned)),
        **_gap_entries("predictable_gap_closed_late", gap_closed(received, rewards, "predictable", rewards.late, learned_late)),
        "regret": {oracle: float((values - received).mean()) for oracle, values in rewards.oracles.items()},
        "regret_ci95": {oracle: difference_ends(rewards, oracle, values - received, learned) for oracle, values in rewards.oracles.items()},
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


def difference_ends(rewards: Curves, oracle: str, values: Array, learned: Array | float = 0.0) -> list[float] | None:
    """95 % interval of the mean of values (S, T) that an oracle's rewards went into: over units, and what the oracle may be off."""
    found = over_units(values, rewards.order, rewards.units, learned)
    return None if found is None else _ends(replace(found, error=math.hypot(found.error, rewards.error(oracle))))


def gap_closed(received: Array, rewards: Curves, oracle: str | None, first: int, learned: Array | float = 0.0) -> tuple[float, Interval] | None:
    """Share of the gap to an oracle closed from decision `first` on, with its 95 % interval over units and what the expected oracle may be off.

    (selector - best single) / (oracle - best single), all averaged over seeds and decisions; the interval is that of a ratio (delta method). None
    where the oracle's gain is below the margin or not more than its error, so that there is no gap to share, or where it is no bound because a
    selector beat it.

    Args:
        learned: (N,) as `Streamed.learned` gives it.
    """
    if oracle not in rewards.oracles or not rewards.gains[oracle].beyond_error():
        return None
    order, base = rewards.order[:, first:], rewards.oracles["best_single"][:, first:]
    gains, gaps = received[:, first:] - base, rewards.oracles[oracle][:, first:] - base
    gap = float(gaps.mean())
    if gap < max(rewards.margin, ROUNDING):
        return None
    share = float(gains.mean()) / gap
    found = over_units(gains - share * gaps, order, rewards.units, learned)
    if found is None or found.units < 2:
        return None
    half = replace(found, error=math.hypot(found.error, share * rewards.error(oracle))).half(0.025) / gap
    return share, (share - half, share + half)


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
    """Mean differences in reward between any two selectors on the same streams, with intervals over units, and the spread over orders."""
    result = []
    for index, one in enumerate(names):
        for other in names[index + 1 :]:
            apart = rewards.selectors[one] - rewards.selectors[other]
            late = slice(rewards.late, None)
            result.append(
                {
                    "a": one,
                    "b": other,
                    "difference": float(apart.mean()),
                    "ci95": _ends(over_units(apart, rewards.order, rewards.units)),
                    "orders_ci95": _orders(apart),
                    "difference_late": float(apart[:, late].mean()),
                    "ci95_late": _ends(over_units(apart[:, late], rewards.order[:, late], rewards.units)),
                }
            )
    return result


def _orders(values: Array) -> list[float] | None:
    """95 % bootstrap interval over seeds of the mean of values (S, T): what another order of the same instances would change; None of one seed."""
    return list(bootstrap_mean_interval(values.mean(axis=1))) if len(values) > 1 else None


def _ends(found: UnitMean | None, within: Interval = (-math.inf, math.inf)) -> list[float] | None:
    """A 95 % interval for a file; None where it is unbounded, for want of units."""
    if found is None or found.units < 2:
        return None
    return [min(max(end, within[0]), within[1]) for end in found.interval()]


def _with_interval(name: str, estimate: Estimate | None) -> dict[str, Any]:
    return {name: None if estimate is None else [estimate.low, estimate.high]}


def _gap_entries(name: str, found: tuple[float, Interval] | None) -> dict[str, Any]:
    share, interval = found or (None, None)
    return {name: share, f"{name}_ci95": None if interval is None else list(interval)}


def _mean(values: Array) -> float | None:
    """Mean of what is known; None where nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None
