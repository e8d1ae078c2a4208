"""The verdict in words, in the user's units first: successes, cents, seconds; then reward, and what its weights mean."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from osel_sim.selection.weights import RewardWeights

if TYPE_CHECKING:
    from osel_sim.analysis.measures import Curves

Measures = Mapping[str, Any]
"""What was measured of a way of choosing (`osel_sim.analysis.measures.measure_selector`)."""


def headline(found: Mapping[str, Any]) -> str:
    """The answer.

    Args:
        found: as `osel_sim.analysis.verdict.verdict` returns it.
    """
    if found["decision"] == "route":
        return f"Route with {found['selector']}"
    if found["decision"] == "do_not_route":
        return f"Do not route: always use {found['policy']}"
    more = found["more"]
    return "Not enough data to tell" + (f": about {more:,} more instances would" if more else "")


def sentences(found: Mapping[str, Any], selector: Measures | None, single: Measures, weights: RewardWeights, limit: str = "") -> list[str]:
    """Why, and what is at stake.

    Args:
        found: as `osel_sim.analysis.verdict.verdict` returns it.
        selector: what was measured of the selector at stake; None where there is none.
        single: the same of always the best single policy.
        limit: what could be gained at most.
    """
    stake = found["stake"]
    told = (
        []
        if selector is None or stake is None
        else [in_units(f"Routing with {stake['selector']}", selector, found["policy"], single), _in_reward(stake)]
    )
    return [sentence for sentence in (*told, _reason(found), limit, worth(weights)) if sentence]


def in_units(who: str, selector: Measures, policy: str, single: Measures) -> str:
    """`Routing with auto: 77% success at 4.2 cents and 7.8 s, against 76% at 16.8 cents and 8.2 s for always remote_large.`"""
    own, other = _amounts(selector), _amounts(single)
    both = [key for key in own if key in other]
    if not both:
        return f"{who}, against always {policy}: nothing but the reward is known of both."
    what = {"success_rate": " success", "mean_subgoals": " of the subgoals", "mean_score": " mean score"}
    mine = [own[key] + what.get(key, "") for key in both]
    return f"{who}: {_at(mine)}, against {_at([other[key] for key in both])} for always {policy}."


def worth(weights: RewardWeights) -> str:
    """What the reward's weights mean."""
    unit = {"success": "a success", "subgoals": "a task done", "score": "a point of score"}[weights.success]
    parts = []
    if weights.alpha_price > 0.0:
        parts.append(f"{unit} is worth {1.0 / weights.alpha_price:,.4g} cents")
    if weights.alpha_time > 0.0:
        slower = "100 steps more cost" if weights.time_unit == "steps" else "ten times slower costs"
        parts.append(f"{slower} {weights.alpha_time * (100.0 if weights.time_unit == 'steps' else 1.0):.3g} of {unit}")
    nothing = [name for name, weight in (("time", weights.alpha_time), ("price", weights.alpha_price)) if weight == 0.0]
    if nothing:
        parts.append(f"{' and '.join(nothing)} {'count' if len(nothing) > 1 else 'counts'} nothing")
    return f"In this reward {', '.join(parts)}."


def limit(rewards: "Curves") -> str:
    """What could be gained at most."""
    if rewards.learnable is None:
        return f"How much can be learned is not known: {rewards.beaten['predictable']} earned more than the predictable oracle."
    found = rewards.gains[rewards.learnable]
    low, high = found.interval
    oracle = "an oracle" if rewards.learnable == "expected" else "an oracle trained on all outcomes of the other half of the instances"
    amount = f"{found.mean:+.3f} a decision (between {low:+.3f} and {high:+.3f})"
    if not found.beyond_error():
        return f"No gap to close is seen: {oracle} comes to {amount} over it, which may be chance."
    if found.mean < rewards.margin:
        return f"There is no gap to close: {oracle} gains no more than {amount} over it."
    return f"{oracle[:1].upper()}{oracle[1:]} gains {amount} over it."


def _in_reward(stake: Mapping[str, Any]) -> str:
    low, high = stake["gain_late_bounds"]
    return (
        f"In reward that is {stake['gain']:+.3f} a decision, its learning included, and {stake['gain_late']:+.3f} in the last quarter of its streams "
        f"(between {_bound(low)} and {_bound(high)})."
    )


def _reason(found: Mapping[str, Any]) -> str:
    margin = f"{found['margin']:g}"
    if found["decision"] == "route":
        cost = found["stake"]["gain_bounds"][0]
        return "" if cost is not None and cost > 0.0 else "Learning costs something first: over the whole stream the gain is not proven."
    if found["decision"] == "do_not_route":
        return f"Neither it nor a router trained on all outcomes gains {margin} or more: the upper bound is {_bound(found['ceiling'])}."
    units, instances = found["test"]["units"], found["test"]["instances"]
    few = f"{units:,} different scenes or texts" if units < instances else f"{instances:,} instances"
    return f"Of {few}, a gain is not shown, nor is one of {margin} ruled out; always {found['policy']} is the best single policy so far."


def _amounts(measures: Measures) -> dict[str, str]:
    """What is known, in its units, what the reward counts as success first."""
    found = {}
    if measures.get("mean_score") is not None:
        found["mean_score"] = f"{measures['mean_score']:.4g}"
    elif measures.get("success_rate") is not None:
        found["success_rate"] = f"{100 * measures['success_rate']:.0f}%"
    if measures.get("mean_price") is not None:
        found["mean_price"] = f"{_plain(measures['mean_price'])} cents"
    if measures.get("mean_seconds") is not None:
        found["mean_seconds"] = f"{_plain(measures['mean_seconds'])} s"
    elif measures.get("mean_steps") is not None:
        found["mean_steps"] = f"{measures['mean_steps']:.0f} steps"
    return found


def _at(parts: list[str]) -> str:
    """`77% success at 4.2 cents and 7.8 s`."""
    return " at ".join(part for part in (parts[0], " and ".join(parts[1:])) if part)


def _plain(value: float) -> str:
    """One decimal, or two digits of what is smaller: prices by the token are hundredths of a cent."""
    return f"{value:,.1f}" if abs(value) >= 0.95 or value == 0.0 else f"{value:.2g}"


def _bound(value: float | None) -> str:
    return "no bound" if value is None else f"{value:+.3f}"
