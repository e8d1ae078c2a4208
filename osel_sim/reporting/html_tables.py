"""Tables: what they hold, as CSV, and their cells as text for the page."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from osel_sim.analysis.estimate import Estimate
from osel_sim.core import csv_text
from osel_sim.core.errors import UsageError

Cell = str | int | float | bool | Estimate | None
"""What a table holds; None where there is nothing to say."""


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        key: name in the CSV and in the rows.
        heading: with its unit.
        style: how to write its numbers; `percent` takes a share in [0, 1].
        digits: after the point; None: by the magnitude of the column, as `digits_of`.
    """

    key: str
    heading: str
    style: Literal["text", "number", "percent"] = "number"
    digits: int | None = 2


@dataclass(frozen=True)
class Table:
    """One table.

    Attributes:
        name: of its file.
        rows: a cell for each column's key.
    """

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Cell]]

    def __post_init__(self) -> None:
        keys = {column.key for column in self.columns}
        for row in self.rows:
            if row.keys() != keys:
                raise UsageError(f"table {self.name}: a row has {sorted(row)}, the columns are {sorted(keys)}")
        columns = [column if column.digits is not None else replace(column, digits=digits_of(self._numbers(column.key))) for column in self.columns]
        object.__setattr__(self, "columns", columns)

    @property
    def has_intervals(self) -> bool:
        """Whether some cell has an interval to show."""
        return any(to_parts(row[column.key], column)[1] for row in self.rows for column in self.columns)

    def _numbers(self, key: str) -> Iterable[float]:
        for row in self.rows:
            cell = row[key]
            number = cell.value if isinstance(cell, Estimate) else cell
            if isinstance(number, int | float):
                yield number


def digits_of(values: Iterable[float]) -> int:
    """So many digits after the point that the largest of these numbers shows three of its own, and at least one: cents can be 16.9 or 0.0492."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    return 1 if largest == 0.0 else min(12, max(1, 2 - math.floor(math.log10(largest))))


def shortened(text: str, most: int) -> str:
    """At most so many letters, with an ellipsis where it is longer."""
    return text if len(text) <= most else text[: most - 1] + "…"


def to_csv(table: Table) -> str:
    """All digits; an estimate takes three columns: itself, `_low`, `_high`. What is not there is empty."""
    wide = {column.key for column in table.columns if any(isinstance(row[column.key], Estimate) for row in table.rows)}
    headings = [name for column in table.columns for name in _headings(column.key, column.key in wide)]
    return csv_text.to_csv(
        [headings, *([text for column in table.columns for text in _values(row[column.key], column.key in wide)] for row in table.rows)]
    )


def to_text(cell: Cell, column: Column) -> str:
    """A cell as people read it: `63% [60, 66]`, `1.25`, or a dash where there is nothing."""
    return " ".join(part for part in to_parts(cell, column) if part)


def to_parts(cell: Cell, column: Column) -> tuple[str, str]:
    """A cell's value and its interval, which is empty where there is none: `63%` and `[60, 66]`."""
    if not isinstance(cell, Estimate):
        return _text(cell, column), ""
    value = _text(cell.value, column)
    if value == "–" or not (math.isfinite(cell.low) and math.isfinite(cell.high)):
        return value, ""
    low, high = (_text(end, column).removesuffix("%") for end in (cell.low, cell.high))
    return value, f"[{low}, {high}]"


def _text(cell: str | float | bool | None, column: Column) -> str:
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, str) or column.style == "text":
        return str(cell)
    if column.style == "percent":
        return f"{100 * cell:.0f}%".replace("-", "\u2212")
    digits = digits_of([cell]) if column.digits is None else column.digits  # a column of a table knows its digits
    return (f"{cell:,}" if isinstance(cell, int) else f"{cell:,.{digits}f}").replace("-", "\u2212")


def _headings(key: str, wide: bool) -> list[str]:
    return [key, f"{key}_low", f"{key}_high"] if wide else [key]


def _values(cell: Cell, wide: bool) -> list[str]:
    parts: list[Cell] = [cell.value, cell.low, cell.high] if isinstance(cell, Estimate) else [cell, None, None]
    return [_exact(part) for part in (parts if wide else parts[:1])]


def _exact(cell: Cell) -> str:
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    return repr(cell) if isinstance(cell, float) else str(cell)
