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
        cents an episode), and under `policies` the same for the decisions each policy was chosen for. A mean over nothing is null.
    """
    return {
        "selector": selector,
        **_part(decisions),
        "policies": {policy: _part([decision for decision in decisions if decision.policy == policy]) for policy in policies},
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


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
