"""`summary.json`: what a live run came to."""

from collections.abc import Sequence
from typing import Any

from osel_sim.formats.journal import Decision
from osel_sim.statistics.intervals import wilson_interval


def summarise(decisions: Sequence[Decision], policies: Sequence[str], selector: str) -> dict[str, Any]:
    """Means over the decisions with a valid outcome; those that ended in error are counted apart, never as failures.

    Returns:
        selector, decisions, errors, fallbacks, mean_reward, success_rate (with its 95 % Wilson interval), mean_steps, mean_seconds, price (mean, in
        cents an episode), and under `policies` the same for the decisions each policy was chosen for. A mean over nothing is null.
    """
    return {
        "selector": selector,
        **_part(decisions),
        "policies": {policy: _part([decision for decision in decisions if decision.policy == policy]) for policy in policies},
    }


def _part(decisions: Sequence[Decision]) -> dict[str, Any]:
    valid = [decision for decision in decisions if decision.error is None]
    successes = sum(decision.success for decision in valid)
    return {
        "decisions": len(decisions),
        "errors": len(decisions) - len(valid),
        "fallbacks": sum(decision.fallback is not None for decision in decisions),
        "success_rate": _mean([float(decision.success) for decision in valid]),
        "success_interval": list(wilson_interval(successes, len(valid))),
        "mean_reward": _mean([decision.reward for decision in valid if decision.reward is not None]),
        "mean_steps": _mean([float(decision.steps) for decision in valid]),
        "mean_seconds": _mean([decision.seconds.motion for decision in valid]),
        "price": _mean([decision.price for decision in valid]),
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
