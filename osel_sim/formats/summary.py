"""`summary.json`: what a live run came to."""

from collections.abc import Sequence
from typing import Any

from osel_sim.formats.journal import Decision
from osel_sim.interface.outcome import credited
from osel_sim.statistics.intervals import wilson_interval


def summarise(decisions: Sequence[Decision], policies: Sequence[str], selector: str) -> dict[str, Any]:
    """Means over the decisions with a valid outcome; those that ended in error are counted apart, never as failures.

    Returns:
        selector, decisions, errors, fallbacks (episodes in which one took over), solved_by_fallback (those of them that succeeded), mean_reward,
        success_rate (with its 95 % Wilson interval; without what a fallback solved from the first call on), mean_steps, mean_seconds, price (mean, in
        cents an episode), and under `policies` the same for the decisions each policy was chosen for. A mean over nothing is null.
    """
    return {
        "selector": selector,
        **_part(decisions),
        "policies": {policy: _part([decision for decision in decisions if decision.policy == policy]) for policy in policies},
    }


def _part(decisions: Sequence[Decision]) -> dict[str, Any]:
    valid = [decision for decision in decisions if decision.error is None]
    successes = [credited(decision, "success") for decision in valid]
    fallbacks = [decision for decision in decisions if decision.fallback is not None]
    return {
        "decisions": len(decisions),
        "errors": len(decisions) - len(valid),
        "fallbacks": len(fallbacks),
        "solved_by_fallback": sum(decision.success and decision.error is None for decision in fallbacks),
        "success_rate": _mean(successes),
        "success_interval": list(wilson_interval(sum(successes), len(valid))),
        "mean_reward": _mean([decision.reward for decision in valid if decision.reward is not None]),
        "mean_steps": _mean([float(decision.steps) for decision in valid]),
        "mean_seconds": _mean([decision.seconds.motion for decision in valid]),
        "price": _mean([decision.price for decision in valid]),
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
