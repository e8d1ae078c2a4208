"""A replay of moments on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from osel_sim.cli.console import Table, number, percent, plain


def print_moments(console: Console, result: Mapping[str, Any]) -> None:
    """Print start selectors with monitors, what switching without looking comes to at their duty, the oracles, and the verdict."""
    calls = ", ".join(map(str, result["calls"]))
    title = f"{result['instances']} instances, learned from {result['learned_from']} others; decision points before calls {calls}"
    headings = ("reward", "gain [95%]", "p (Holm)", "success", "cents", "duty", "recovered", "harmed", "of the gap")
    table, idle = Table(title, ("at the start", "monitor"), headings), dict[str, list[str]]()
    starts = sorted(dict.fromkeys(arm["start"] for arm in result["arms"]), key=lambda start: -_alone(result, start)["reward"][0])
    for start in starts:
        own = [arm for arm in result["arms"] if arm["start"] == start]
        idle[start] = [arm["monitor"] for arm in own if _does_nothing(arm, _alone(result, start))]
        for arm in sorted((arm for arm in own if arm["monitor"] not in idle[start]), key=lambda arm: -arm["reward"][0]):
            table.add(
                start.removeprefix("fixed:"),
                arm["monitor"],
                number(arm["reward"][0], 3),
                _interval(arm.get("gain")),
                "-" if arm.get("p_reward_holm") is None else f"{arm['p_reward_holm']:.2g}",
                *_numbers(arm),
                percent(arm.get("of_gap")),
            )
        table.add_section()
    console.print(table)
    verdict = result["verdict"]
    best = next((arm for arm in result["arms"] if (arm["start"], arm["monitor"]) == (verdict["start"], verdict["monitor"])), None)
    if best is not None and best.get("equal_duty"):
        console.print(_equal_duty(best, best["equal_duty"]))
    for sentence in [*_notes(result), *_idle(idle)]:
        console.print(plain(sentence), soft_wrap=True)
    console.print(plain(verdict["headline"], "bold"), soft_wrap=True)
    for sentence in verdict["sentences"]:
        console.print(plain(sentence), soft_wrap=True)


def _alone(result: Mapping[str, Any], start: str) -> Mapping[str, Any]:
    return next(arm for arm in result["arms"] if (arm["start"], arm["monitor"]) == (start, "never"))


def _does_nothing(arm: Mapping[str, Any], alone: Mapping[str, Any]) -> bool:
    return arm is not alone and arm["reward"] == alone["reward"] and arm["duty"] == alone["duty"]


def _idle(idle: Mapping[str, Sequence[str]]) -> list[str]:
    """Which monitors handed nothing over, where there are some."""
    after = dict[str, list[str]]()
    for start, names in idle.items():
        after.setdefault("; ".join(names), []).append(start.removeprefix("fixed:"))
    return [f"nothing is handed over by {names} after {', '.join(starts)}" for names, starts in after.items() if names]


def _equal_duty(best: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(
        f"{best['start']} with {best['monitor']}, and switching without looking at the same duty",
        ("monitor",),
        ("mean reward [95%]", "it is behind by [95%]", "success", "cents", "duty", "recovered", "harmed"),
    )
    table.add(best["monitor"], _interval(best["reward"]), "-", *_numbers(best))
    for other in others:
        table.add(other["name"], _interval(other["reward"]), _interval(other["ahead"]), *_numbers(other))
    return table


def _numbers(arm: Mapping[str, Any]) -> list[str]:
    return [percent(arm["success"][0]), number(arm["price"][0]), *(percent(arm[name]) for name in ("duty", "recovered", "harmed"))]


def _notes(result: Mapping[str, Any]) -> list[str]:
    found = result["oracles"]
    notes = [
        "recovered: of the episodes that the first policy alone would lose; harmed: of those it would win; duty: steps that remote policies drive"
    ]
    if found is not None:
        notes.append(
            f"oracles on the {found['instances']} instances with repeats: of choosing once {_interval(found['once'])}, of when "
            f"{_interval(found['when'])}, always {found['single']} {found['single_reward']:.3f}; in hindsight "
            f"{found['hindsight_once']:.3f} and {found['hindsight_when']:.3f}"
        )
    return notes


def _interval(found: Sequence[float] | None) -> str:
    if found is None:
        return "-"
    value, low, high = found
    return f"{value:.3f} [{low:.3f}, {high:.3f}]"
