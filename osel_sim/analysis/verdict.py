"""Is routing worth it on this log? The answer in words, from a sequential test, with what is at stake."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from osel_sim.analysis.measures import Curves
from osel_sim.statistics.betting import advantage_bounds

ERROR = 0.05
"""Probability, at most, of advising to route where no selector is better than the best single policy."""

METHOD = "betting with an empirical Bernstein correction; exponents averaged over seeds; error split over selectors, whole stream and last quarter"

RECOMMENDED = "auto"
"""The selector that is to be used where nobody chose one. It gets half of the allowed error for itself, the others share the rest."""


@dataclass(frozen=True)
class Advantage:
    """A selector's advantage over always using the best single policy, in reward a decision.

    Attributes:
        mean, late: over the whole stream and over its last quarter.
        low, high, late_low, late_high: bounds on the two; all of them, of all selectors, hold at once with probability 1 - 2 * `ERROR`.
    """

    mean: float
    low: float
    high: float
    late: float
    late_low: float
    late_high: float

    @property
    def proven(self) -> bool:
        """Whether it is better over the whole stream or, once it has learned, at its end."""
        return self.low > 0.0 or self.late_low > 0.0


def advantages(rewards: Curves, learners: Sequence[str], span: float) -> dict[str, Advantage]:
    """Advantage of every learner, with bounds that hold for all of them at once.

    Args:
        span: rewards lie within an interval of this length.
    """
    result = {}
    for name in learners:
        differences = rewards.selectors[name] - rewards.oracles["best_single"]
        others = len(learners) - (RECOMMENDED in learners)
        share = 1.0 if len(learners) == 1 else 0.5 if name == RECOMMENDED else (0.5 if RECOMMENDED in learners else 1.0) / others
        # Half for the whole stream, half for its end.
        whole, late = (advantage_bounds(part, span, ERROR * share / 2.0) for part in (differences, differences[:, rewards.late :]))
        result[name] = Advantage(float(differences.mean()), *whole, float(differences[:, rewards.late :].mean()), *late)
    return result


def verdict(rewards: Curves, learners: Sequence[str], measured: Mapping[str, Mapping[str, Any]], policy: str, span: float) -> dict[str, Any]:
    """What to do.

    Args:
        learners: selectors that may be advised.
        measured: selector -> what was measured of it (`osel_sim.analysis.measures.measure_selector`); `fixed:<policy>` among them.
        policy: the best single policy.
        span: rewards lie within an interval of this length.

    Returns:
        decision (`route` or `do_not_route`), selector (the one to route with, or None), policy (the best single one), text, stake (what is gained or
        lost a decision), test (how it was found).
    """
    found = advantages(rewards, learners, span) if span > 0.0 else {}
    proven = {name: advantage for name, advantage in found.items() if advantage.proven}
    # By what it earns once it has learned, where that is proven; a stream's beginning is paid once.
    best = max(proven or found, key=lambda name: (found[name].late + found[name].mean) / 2.0, default=None)
    decision = "route" if proven else "do_not_route"
    learnable = None if rewards.learnable is None else rewards.gains[rewards.learnable]
    stake: dict[str, Any] = {
        "learnable_oracle": rewards.learnable,
        "learnable_gain": None if learnable is None else learnable.mean,
        "learnable_gain_ci95": None if learnable is None else learnable.ends,
    }
    if best is not None:
        advantage, mine, fixed = found[best], measured[best], measured[f"fixed:{policy}"]
        stake |= {
            "selector": best,
            "gain": advantage.mean,
            "gain_bounds": [advantage.low, advantage.high],
            "gain_late": advantage.late,
            "gain_late_bounds": [advantage.late_low, advantage.late_high],
            **{key: _difference(mine[key], fixed[key]) for key in ("success_rate", "mean_seconds", "mean_steps", "mean_price")},
        }
    decisions = rewards.oracles["best_single"].shape[1]
    text = _text(decision, best, policy, found.get(best) if best else None, stake, decisions, _limit(rewards))
    return {
        "decision": decision,
        "selector": best if proven else None,
        "policy": policy,
        "text": text,
        "stake": stake,
        "test": {
            "method": METHOD,
            "error": ERROR,
            "reward_span": span,
            "advantages": {name: vars(advantage) for name, advantage in found.items()},
        },
    }


def _text(decision: str, best: str | None, policy: str, advantage: Advantage | None, stake: Mapping[str, Any], decisions: int, limit: str) -> str:
    if best is None or advantage is None:
        return f"Do not route: always use {policy}. {limit}"
    whole = f"{advantage.mean:+.3f} reward a decision over {decisions} decisions (between {advantage.low:+.3f} and {advantage.high:+.3f})"
    late = f"{advantage.late:+.3f} in the last quarter (between {advantage.late_low:+.3f} and {advantage.late_high:+.3f})"
    if decision == "route":
        cost = "" if advantage.low > 0.0 else " Learning costs something first: over the whole stream the gain is not proven."
        return f"Route with {best}: it gains {whole}, {late}, compared with always using {policy}.{cost} {_effects(stake)}{limit}"
    return f"Do not route: always use {policy}. No selector was shown to beat it: the best, {best}, came to {whole}, {late}. {_effects(stake)}{limit}"


def _limit(rewards: Curves) -> str:
    """What could be gained at most."""
    if rewards.learnable is None:
        return f"How much can be learned is not known: {rewards.beaten['predictable']} earned more than the predictable oracle."
    gain = rewards.gains[rewards.learnable]
    low, high = gain.interval
    amount = f"{gain.mean:+.3f} a decision (between {low:+.3f} and {high:+.3f})"
    oracle = "oracle" if rewards.learnable == "expected" else "oracle trained on all outcomes of the other half of the instances"
    if not gain.beyond_error():
        return f"No gap to close is seen: an {oracle} came to {amount} over it, which may be chance."
    return f"An {oracle} gains {amount} over it."


def _effects(stake: Mapping[str, Any]) -> str:
    parts = []
    if stake.get("success_rate") is not None:
        parts.append(f"{100 * stake['success_rate']:+.1f} points of success")
    if stake.get("mean_seconds") is not None:
        parts.append(f"{_signed(stake['mean_seconds'])} s")
    elif stake.get("mean_steps") is not None:
        parts.append(f"{stake['mean_steps']:+.1f} steps")
    if stake.get("mean_price") is not None:
        parts.append(f"{_signed(stake['mean_price'])} cents")
    return f"That is {', '.join(parts)} a decision. " if parts else ""


def _signed(value: float) -> str:
    """Two decimals, or two digits of what is smaller: prices by the token are hundredths of a cent."""
    return f"{value:+.2f}" if abs(value) >= 0.095 or value == 0.0 else f"{value:+.2g}"


def _difference(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one - other


def reward_span(rewards: np.ndarray[Any, Any]) -> float:
    """Length of the interval that all rewards of a log lie in."""
    known = rewards[np.isfinite(rewards)]
    return float(known.max() - known.min())
