"""Tables on the terminal. What they hold are names and words of others: `model [v2]` is no markup, `:fire:` no emoji."""

import sys
from collections.abc import Iterable, Sequence
from typing import Any

from rich import table
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from osel_sim.core.shown import shown
from osel_sim.selection.registry import RECOMMENDATION, is_recommended

MOST_POLICIES = 24
"""Of so many policies a table tells; of more, only of the best. Their outcomes are in the files and on the page."""


class SafeConsole(Console):
    """A console on which only rich's own control codes reach the terminal, and none that stands in a text."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of anything, their texts as they may be shown."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)


def console() -> Console:
    """Standard output; wide enough for a table where it is no terminal."""
    return SafeConsole(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False, markup=False, emoji=False)


def plain(text: str, style: str = "") -> Text:
    """A text for the terminal that is shown as it is, on any console."""
    return Text(shown(text), style)


class Table(table.Table):
    """The tables of all commands. Cells are texts as they are; one too long for its column is folded, never cut off.

    Args:
        title: above it.
        texts: headings of the first columns.
        numbers: headings of the others, whose cells stand on the right.
    """

    def __init__(self, title: str, texts: Sequence[str], numbers: Sequence[str] = ()) -> None:
        super().__init__(title=plain(title, "italic"), title_justify="left")
        for heading in texts:
            self.add_column(plain(heading), overflow="fold")
        for heading in numbers:
            self.add_column(plain(heading), overflow="fold", justify="right")

    def add(self, *cells: str | Text) -> None:
        """Add a row; a `Text` keeps its style."""
        self.add_row(*(plain(cell) if isinstance(cell, str) else cell for cell in cells))


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
    headings = ("decisions", "mean reward", "success [95%]", "steps", "seconds", "price (cents)", "fallbacks", "solved by them", "errors")
    found = Table(f"{summary['task']}: {summary['decisions']} decisions", [""], headings)
    if not is_recommended(summary["selector"]):
        found.caption, found.caption_justify = plain(f"{RECOMMENDATION}."), "left"
    chosen = ((plain(f"  chose {name}"), part) for name, part in summary["policies"].items())
    for name, part in ((plain(summary["selector"], "bold"), summary), *chosen):
        found.add(
            name,
            str(part["decisions"]),
            number(part["mean_reward"], 3),
            percent(part["success_rate"], part["success_interval"] if part["decisions"] else None),
            number(part["mean_steps"], 1),
            number(part["mean_seconds"], 2),
            number(part["price"]),
            str(part["fallbacks"]),
            str(part["solved_by_fallback"]),
            str(part["errors"]),
        )
    if "regret" in summary:
        found.add_section()
        for name, value in summary["always"].items():
            found.add(f"always {name}" + (" (best single)" if name == summary["best_single_policy"] else ""), "", number(value, 3))
        found.add("hindsight oracle", "", number(summary["hindsight_oracle"], 3))
        found.add("regret a decision", "", number(summary["regret"], 3))
    return found
