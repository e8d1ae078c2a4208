"""Whether to hand over within an episode, in words."""

from collections.abc import Mapping
from typing import Any

from osel_sim.analysis.moment_arms import FIXED

FEWEST = 10
"""Instances with repeats that a sentence about the oracles needs."""
ERROR = 0.05
"""Of the tests of all monitors together that none gains anything (Holm)."""


def verdict(result: Mapping[str, Any]) -> dict[str, Any]:
    """The answer for the best way to choose at the start: *hand over by X*, *do not hand over*, or *not enough data to tell*.

    Args:
        result: as `osel_sim.analysis.moment_result.study` returns it, without this.

    Returns:
        decision (hand_over, do_not, unknown), start, monitor, headline, sentences.
    """
    arms = result["arms"]
    starts = list(dict.fromkeys(arm["start"] for arm in arms))
    chosen = [start for start in starts if not start.startswith(FIXED)] or starts
    start = max(chosen, key=lambda name: _of(arms, name, "never")["reward"][0])
    alone = _of(arms, start, "never")
    candidates = [arm for arm in arms if arm["start"] == start and arm["monitor"] != "never" and arm.get("gain")]
    if not candidates:
        return {"decision": "do_not", "start": start, "monitor": None, "headline": "Do not hand over: no monitor was compared", "sentences": []}
    best = max(candidates, key=lambda arm: arm["gain"][0])
    gain, low, high = best["gain"]
    if low > 0.0 and best["p_reward_holm"] < ERROR:
        decision, headline = "hand_over", f"Hand over by {best['monitor']}"
    elif max(arm["gain"][2] for arm in candidates) < result["margin"]:
        decision, headline = "do_not", f"Do not hand over: let {_who(start)} drive to the end"
    else:
        decision, headline = "unknown", "Not enough data to tell whether to hand over"
    sentences = [
        f"With {_who(start)} at the start: {_numbers(best)} with {best['monitor']}, against {_numbers(alone)} without a monitor.",
        f"In reward that is {gain:+.3f} an episode (95% interval {low:+.3f} to {high:+.3f}, over {result['instances']} instances; "
        f"p {best['p_reward_holm']:.3g} with Holm's correction over {len(candidates)} monitors).",
        *_equal(best),
        *_oracle(result),
        "Monitors with one handoff an episode at most are measured exactly; what two and more would come to, this table does not know.",
    ]
    return {"decision": decision, "start": start, "monitor": best["monitor"], "headline": headline, "sentences": sentences}


def _of(arms: Any, start: str, monitor: str) -> Any:
    return next(arm for arm in arms if (arm["start"], arm["monitor"]) == (start, monitor))


def _who(start: str) -> str:
    return f"always {start.removeprefix(FIXED)}" if start.startswith(FIXED) else start


def _numbers(arm: Mapping[str, Any]) -> str:
    return f"{100 * arm['success'][0]:.0f}% success at {arm['price'][0]:.1f} cents and {arm['seconds'][0]:.1f} s ({100 * arm['duty']:.0f}% duty)"


def _equal(best: Mapping[str, Any]) -> list[str]:
    """Against blind switching at the same duty."""
    blind = [arm for arm in best.get("equal_duty", ()) if arm["recovered"] is not None]
    if not blind or best["recovered"] is None:
        return []
    other = max(blind, key=lambda arm: arm["recovered"])
    harmed = "" if best["harmed"] is None else f" and harms {100 * best['harmed']:.0f}% of those that would have been won"
    return [
        f"It recovers {100 * best['recovered']:.0f}% of the episodes that the first policy alone would lose{harmed}; "
        f"switching without looking at the same duty ({other['name']}) recovers {100 * other['recovered']:.0f}%."
    ]


def _oracle(result: Mapping[str, Any]) -> list[str]:
    found = result["oracles"]
    if found is None or found["instances"] < FEWEST:
        return ["Too few instances have repeats to say what could be gained at most."]
    gain, low, high = found["when_over_once"]
    return [
        f"The best schedule of each instance, chosen and scored on different repeats, comes to {found['when'][0]:.3f}; the best single choice at "
        f"the start to {found['once'][0]:.3f} ({found['instances']} instances with repeats): knowing when is worth {gain:+.3f} "
        f"({low:+.3f} to {high:+.3f})."
    ]
