"""A comparison on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from osel_sim.cli.console import Table, plain
from osel_sim.reporting.comparison import Rows, difference_rows, letter_rows, losses_first, notes, pair_rows, plan_rows, task_rows

FLIPS = 10
"""Most instances that are listed; `compare.json` has all."""


def print_compare(console: Console, result: Mapping[str, Any]) -> None:
    """Print each policy beside the first, all pairs where there are more than two, and the verdict."""
    first = result["policies"][0]["name"]
    for entry in result["pairs"]:
        if entry["first"] != first:
            continue
        console.print(_table(f"{entry['second']} compared with {first}", difference_rows(entry), 1))
        if entry["tasks"]:
            console.print(_table("success by task", task_rows(entry), 1))
        for note in notes(entry):
            console.print(plain(note), soft_wrap=True)
        for flip in losses_first(entry)[:FLIPS]:
            console.print(plain(f"  {flip['instance']}: {flip['first']:.2g} -> {flip['second']:.2g}"), soft_wrap=True)
        if len(entry["flips"]) > FLIPS:
            console.print(plain(f"  and {len(entry['flips']) - FLIPS} more instances that changed: compare.json (--out) has them"))
    if len(result["policies"]) > 2:
        console.print(_table("all pairs", pair_rows(result), 2))
        console.print(_table("policies that share a letter were not told apart", letter_rows(result), 2))
    console.print(plain(result["verdict"]["text"], "bold"), soft_wrap=True)


def print_plan(console: Console, result: Mapping[str, Any]) -> None:
    """Print how many instances are needed."""
    console.print(_table("instances needed", plan_rows(result), 2))
    for entry in result["plan"]:
        have = "the log has enough" if not entry["more"] else f"{entry['more']} more than the log has"
        text = (
            f"{entry['needed']} instances find a difference of {100 * entry['detect']:g} points between {entry['first']} and {entry['second']} "
            f"with a probability of {100 * entry['power']:g}%: {have}."
        )
        console.print(plain(text), soft_wrap=True)


def _table(title: str, rows: Rows, texts: int) -> Table:
    found = Table(title, rows[0][:texts], rows[0][texts:])
    for row in rows[1:]:
        found.add(*row)
    return found
