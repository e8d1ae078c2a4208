"""`summary.json`: what a live run came to."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.formats.journal import JOURNAL, LOST, Decision
from osel_sim.interface.outcome import credited
from osel_sim.statistics.intervals import wilson_interval

SUMMARY = "summary.json"


def summarise(decisions: Sequence[Decision], policies: Sequence[str], selector: str) -> dict[str, Any]:
    """Means over the decisions with a valid outcome; those that ended in error are counted apart, never as failures.

    Returns:
        selector, decisions, errors, fallbacks (episodes in which one took over), solved_by_fallback (those of them that succeeded), mean_reward,
        success_rate (with its 95 % Wilson interval; without what a fallback solved from the first call on), mean_steps, mean_seconds, price (mean, in
        cents an episode), and under `policies` the same for the decisions each policy was chosen for. A mean over nothing is null. Where a monitor
        watched, under `monitor`: handoffs (mean, an episode), duty_steps and duty_calls (shares of all steps and calls), price_by_policy (mean, in
        cents an episode).
    """
    return {
        "selector": selector,
        **_part(decisions),
        "policies": {policy: _part([decision for decision in decisions if decision.policy == policy]) for policy in policies},
        **_monitored(decisions),
    }


def check_summary(folder: Path, decisions: int) -> None:
    """Refuse an empty journal beside the summary of one that was not.

    Raises:
        DataError: naming both.
    """
    file = folder / SUMMARY
    summed = read_json(file).get("decisions") if file.exists() else None
    if isinstance(summed, int) and summed > decisions == 0:
        raise DataError(f"{file} is of {summed} decisions, {JOURNAL} beside it has {decisions}: {LOST}")


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


def _monitored(decisions: Sequence[Decision]) -> dict[str, Any]:
    """What a monitor made of the decisions; nothing where none watched."""
    watched = [decision for decision in decisions if decision.monitored is not None and decision.error is None]
    told = [decision.monitored for decision in watched if decision.monitored is not None]
    if not told:
        return {}
    steps = sum(decision.steps for decision in watched)
    calls = sum(driving.calls for one in told for driving in one.by_policy.values())
    drove = sorted({policy for one in told for policy in one.by_policy})
    prices = {policy: sum(one.by_policy[policy].price for one in told if policy in one.by_policy) / len(told) for policy in drove}
    duty_steps = sum(one.duty_steps * decision.steps for one, decision in zip(told, watched, strict=True))
    duty_calls = sum(one.duty_calls * sum(driving.calls for driving in one.by_policy.values()) for one in told)
    return {
        "monitor": {
            "handoffs": _mean([float(len(one.handoffs)) for one in told]),
            "duty_steps": duty_steps / steps if steps else 0.0,
            "duty_calls": duty_calls / calls if calls else 0.0,
            "price_by_policy": prices,
        }
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
