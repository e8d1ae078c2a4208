"""Progress bars: in a terminal on standard error, in a notebook as a widget."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from osel_sim.core.shown import shown


class Bar:
    """A progress bar.

    Args:
        make: makes the bar of tqdm, which is shown, and counts time, from then on.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make, self._made = make, None

    @property
    def _bar(self) -> Any:
        if self._made is None:
            self._made = self._make()
        return self._made

    def begin(self) -> None:
        """Show the bar, if it is not shown yet: loading and compiling before this count for no estimate of the time that is left."""
        self.update(0)

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
    def aside(self) -> Iterator[None]:
        """Take the bar away while the block prints something."""
        from tqdm.auto import tqdm  # type: ignore[import-untyped]

        with tqdm.external_write_mode():
            yield

    def close(self) -> None:
        """End the bar; it stays where it is."""
        if self._made is not None:
            self._made.close()


@contextmanager
def progress(
    total: int | None, unit: str, description: str | None = None, *, initial: int = 0, scale: bool = False, quiet: bool = False
) -> Iterator[Bar]:
    """Give a progress bar for the length of the block. It is shown from its first use on, such as `begin`.

    Args:
        total: number of units; None if not known yet.
        unit: what is counted, in the singular.
        description: stands before the bar.
        initial: units that were done before.
        scale: shorten large numbers (12.3k).
        quiet: show nothing.
    """
    from tqdm.auto import tqdm

    desc = None if description is None else _line(description)
    bar = Bar(lambda: tqdm(total=total, initial=initial, unit=unit, unit_scale=scale, desc=desc, dynamic_ncols=True, disable=quiet))
    try:
        yield bar
    finally:
        bar.close()


def _line(text: str) -> str:
    """A text as one line: names of others stand in it, and a bar is drawn over and over on its line."""
    return shown(text).replace("\n", " ").replace("\t", " ")
