"""A replay of streams that change, on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from osel_sim.cli.console import Table, number, percent, plain


def print_changes(console: Console, result: Mapping[str, Any]) -> None:
    """Print a table a change, when newcomers had their fair share, and what is to be said of it."""
    found, log = result["changes"], result["log"]
    about = f"{result['decisions']} decisions of {log['instances']} instances, {len(result['seeds'])} seeds"
    console.print(plain(f"{about}; {_words(found)}"), soft_wrap=True)
    for index, span in enumerate(found["spans"][1:]):
        console.print(_span_table(found, index, span))
    if any(entry["newcomers"] for entry in found["selectors"].values()):
        console.print(_newcomers(found))
    notes = [
        f"afresh: the same selector begun anew at the change; knew: one that had the policies and prices of after it from the first decision on. "
        f"Differences are a decision, soon: over the {found['window']} decisions after the change, or up to the next.",
        f"fair share: {found['fair']:g} of the share that a newcomer has in the last quarter under the selector that knew; "
        f"it has it once {found['lately']} decisions in a row, over all seeds, give it that much; counted are the decisions before these.",
    ]
    for note in notes:
        console.print(plain(note), soft_wrap=True)
    console.print(plain(result["verdict"]["text"], "bold"), soft_wrap=True)


def _words(found: Mapping[str, Any]) -> str:
    return ", ".join(event["words"] for event in found["events"])


def _span_table(found: Mapping[str, Any], index: int, span: Mapping[str, Any]) -> Any:
    title = f"decisions {span['from']} to {span['to'] - 1}: {', '.join(span['changes'])}"
    headings = ("reward soon", "knew", "afresh", "against knew [95%]", "against afresh [95%]", "regret to oracle", "success", "cents")
    table = Table(title, [""], headings)
    for name, entry in found["selectors"].items():
        own = entry["spans"][index]
        soon, through = own["soon"], own["ways"]["through"]
        table.add(
            name,
            *(number(soon[key], 3) for key in ("mean_reward", "mean_reward_knew", "mean_reward_afresh")),
            *(_difference(soon[key]) for key in ("against_knew", "against_afresh")),
            number(-soon["against_oracle"]["mean"], 3),
            percent(through["success_rate"]),
            number(through["mean_price"]),
        )
    table.add_section()
    best = span["best_single"]
    table.add(f"always {best['policy']} (best there)", number(best["mean_reward"], 3))
    table.add("predictable oracle of what is there", number(span["oracle"], 3))
    return table


def _newcomers(found: Mapping[str, Any]) -> Any:
    table = Table("decisions until a newcomer has its fair share", [""], ("newcomer", "fair share", "decisions", "begun afresh"))
    for name, entry in found["selectors"].items():
        for newcomer in entry["newcomers"]:
            after = [_after(newcomer, way) for way in ("through", "afresh")]
            table.add(name, f"{newcomer['policy']} at {newcomer['at']}", percent(newcomer["fair_share"]), *after)
    return table


def _after(newcomer: Mapping[str, Any], way: str) -> str:
    value = newcomer["decisions"][way]
    return str(value) if value is not None else "-" if newcomer["late_share"] <= 0.0 else f"not in {newcomer['of']}"


def _difference(entry: Mapping[str, Any]) -> str:
    ends: Sequence[float] | None = entry["ci95"]
    return f"{entry['mean']:+.3f}" + (f" [{ends[0]:+.3f}, {ends[1]:+.3f}]" if ends else "")
