"""A table's description as CSV, and its cells as text for the page."""

import math

from osel_sim.analysis.estimate import Estimate
from osel_sim.core import csv_text
from osel_sim.reporting.description import Cell, Column, Table, digits_of


def to_csv(table: Table) -> str:
    """All digits; an estimate takes three columns: itself, `_low`, `_high`. What is not there is empty."""
    wide = {column.key for column in table.columns if any(isinstance(row[column.key], Estimate) for row in table.rows)}
    headings = [name for column in table.columns for name in _headings(column.key, column.key in wide)]
    return csv_text.to_csv(
        [headings, *([text for column in table.columns for text in _values(row[column.key], column.key in wide)] for row in table.rows)]
    )


def to_text(cell: Cell, column: Column) -> str:
    """A cell as people read it: `63% [60, 66]`, `1.25`, or a dash where there is nothing."""
    if isinstance(cell, Estimate):
        value = to_text(cell.value, column)
        if value == "–" or not (math.isfinite(cell.low) and math.isfinite(cell.high)):
            return value
        low, high = (to_text(end, column).removesuffix("%") for end in (cell.low, cell.high))
        return f"{value} [{low}, {high}]"
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
