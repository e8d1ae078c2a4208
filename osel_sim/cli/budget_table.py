"""What selectors came to within budgets, on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from osel_sim.cli.console import Table, number, percent


def print_budget(console: Console, found: Mapping[str, Any] | None) -> None:
    """Print it, where a budget was replayed.

    Args:
        found: `budget` of `replay.json`.
    """
    if not found:
        return
    headings = ("budget (cents)", "reward", "success", "spent", "hindsight oracle", "expected oracle", "best mix")
    table = Table(f"within budgets for {found['period']} decisions, {found['seeds']} orders", ["selector"], headings)
    for name, entries in found["selectors"].items():
        for at, (cents, entry) in enumerate(zip(found["cents"], entries, strict=True)):
            bounds = (found["oracles"][key][at] for key in ("hindsight", "expected", "mix"))
            asked = " (asked)" if cents == found["asked"] else ""
            row = (f"{cents:g}{asked}", number(entry["reward"], 3), percent(entry["success"]), number(entry["spent"]))
            table.add(name, *row, *(number(bound, 3) for bound in bounds))
    console.print(table)
