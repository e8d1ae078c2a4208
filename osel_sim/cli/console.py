"""Tables on the terminal."""

import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table

from osel_sim.core.shown import shown
from osel_sim.selection.registry import RECOMMENDATION, is_recommended


class SafeConsole(Console):
    """A console on which only rich's own control codes reach the terminal, and none that stands in a text."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of anything, their texts as they may be shown."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)


def console() -> Console:
    """Standard output; wide enough for a table where it is no terminal."""
    return SafeConsole(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False)


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(rate: float | None, interval: tuple[float, float] | list[float] | None = None) -> str:
    """A rate in percent with its interval."""
    if rate is None:
        return "-"
    return f"{100 * rate:.0f}%" + (f" [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]" if interval else "")


def run_table(summary: dict[str, Any]) -> Table:
    """The selector, each policy where it was chosen, and with a counterfactual what could have been."""
    hint = None if is_recommended(summary["selector"]) else f"{RECOMMENDATION}."
    table = Table(title=f"{summary['task']}: {summary['decisions']} decisions", title_justify="left", caption=hint, caption_justify="left")
    table.add_column("")
    for heading in ("decisions", "mean reward", "success [95%]", "steps", "seconds", "price (cents)", "fallbacks", "errors"):
        table.add_column(heading, justify="right")
    parts = [(f"[bold]{summary['selector']}[/bold]", summary), *((f"  chose {name}", part) for name, part in summary["policies"].items())]
    for name, part in parts:
        table.add_row(
            name,
            str(part["decisions"]),
            number(part["mean_reward"], 3),
            percent(part["success_rate"], part["success_interval"] if part["decisions"] else None),
            number(part["mean_steps"], 1),
            number(part["mean_seconds"], 2),
            number(part["price"]),
            str(part["fallbacks"]),
            str(part["errors"]),
        )
    if "regret" in summary:
        table.add_section()
        for name, value in summary["always"].items():
            table.add_row(f"always {name}" + (" (best single)" if name == summary["best_single_policy"] else ""), "", number(value, 3))
        table.add_row("hindsight oracle", "", number(summary["hindsight_oracle"], 3))
        table.add_row("regret a decision", "", number(summary["regret"], 3))
    return table
