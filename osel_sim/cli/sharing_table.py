"""What sharing is worth to several robots, on the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from osel_sim.analysis.sharing_words import about, conclusion, title
from osel_sim.cli.console import Table, percent, plain


def print_sharing(console: Console, sharing: Mapping[str, Any]) -> None:
    """Print what each selector earns alone, shared and where one sees everything, and how much of that gap sharing closes."""
    ways = list(next(iter(sharing["selectors"].values()))["ways"])
    table = Table(title(sharing), [""], (*(f"{way} [95%]" for way in ways), "gap [95%]", "closed by sharing [95%]", "bytes a message"))
    for name, entry in sharing["selectors"].items():
        rewards = [_with_interval(entry["ways"][way]["mean_reward"], entry["ways"][way]["ci95"], "") for way in ways]
        gap = _with_interval(entry["gain"], entry["gain_ci95"], "+")
        table.add(name, *rewards, gap, percent(entry["gap_closed"], entry["gap_closed_ci95"]), f"{entry['message_bytes']:,.0f}")
    console.print(table)
    console.print(plain(about(sharing)), soft_wrap=True)
    console.print(plain(conclusion(sharing), "bold"), soft_wrap=True)


def _with_interval(value: float, ends: "list[float] | None", sign: str) -> str:
    return f"{value:{sign}.3f}" + (f" [{ends[0]:{sign}.3f}, {ends[1]:{sign}.3f}]" if ends else "")
