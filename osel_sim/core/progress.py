"""Progress bars: in a terminal on standard error, in a notebook as a widget."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from osel_sim.core.shown import shown


class Bar:
    """A progress bar that is being shown."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def update(self, count: int = 1) -> None:
        """Advance by so many units."""
        self._bar.update(count)

    def at(self, done: int, total: int) -> None:
        """Show `done` of `total` units, where the total is known only on the way."""
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def note(self, text: str) -> None:
        """Show a text behind the bar from its next update on."""
        self._bar.set_postfix_str(_line(text), refresh=False)


@contextmanager
def progress(
    total: int | None, unit: str, description: str | None = None, *, initial: int = 0, scale: bool = False, quiet: bool = False
) -> Iterator[Bar]:
    """Show a progress bar for the length of the block.

    Args:
        total: number of units; None if not known yet.
        unit: what is counted, in the singular.
        description: stands before the bar.
        initial: units that were done before.
        scale: shorten large numbers (12.3k).
        quiet: show nothing.
    """
    from tqdm.auto import tqdm  # type: ignore[import-untyped]

    desc = None if description is None else _line(description)
    with tqdm(total=total, initial=initial, unit=unit, unit_scale=scale, desc=desc, dynamic_ncols=True, disable=quiet) as bar:
        yield Bar(bar)


def _line(text: str) -> str:
    """A text as one line: names of others stand in it, and a bar is drawn over and over on its line."""
    return shown(text).replace("\n", " ").replace("\t", " ")
