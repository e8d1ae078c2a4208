"""One row of a table that knows where it came from, and its cells as numbers and texts; every complaint names file, row and column."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.formats.toml_types import plain_name, quoted

_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}((,\d{3}){2,}(\.\d*)?|,\d{3}\.\d*)")
"""Numbers whose commas are surely thousands: two of them or more, or a decimal point behind one. `1,234` alone may be a decimal comma."""
_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+(\.\d*)?")
DOLLAR = "$"
_BLANK = "\u200b\u200c\u200d\u2060\ufeff"
"""Characters of no width, which are not spaces to Python."""
_LISTED = 30
"""So many names are listed in a message."""


@dataclass(frozen=True)
class Record:
    """One row of a table.

    Attributes:
        number: from 1 on, the header not counted.
        line: where it begins in a text file; None in Parquet and in a JSON array.
        values: column -> text, number, bool or None, for the columns that are wanted. An empty cell is None.
    """

    file: Path
    number: int
    line: int | None
    values: dict[str, Any]

    @property
    def where(self) -> str:
        """`file, row 3 (line 12)`."""
        return f"{self.file}, row {self.number}" + (f" (line {self.line})" if self.line is not None else "")

    def error(self, column: str, problem: str) -> DataError:
        """An error about one cell, to be raised."""
        return DataError(f"{self.where}, column {quoted(column)}: {problem}")


def cell(value: Any) -> Any:
    """A cell as it was read: an empty one, or one of blanks, is None, and bytes are the text they encode, if they do."""
    if isinstance(value, bytes):
        try:
            value = value.decode()
        except UnicodeDecodeError:
            return value
    return None if isinstance(value, str) and not value.strip().strip(_BLANK).strip() else value


def within(row: Any, column: str) -> tuple[Any, bool]:
    """The value of a column of an object, and whether it is there: by its name, or `scores.model` for what is within another."""
    if not isinstance(row, dict):
        return None, False
    if column in row:
        return row[column], True
    start = column.find(".")
    while start > 0:  # the outer name may have dots itself
        value, there = within(row.get(column[:start]), column[start + 1 :])
        if there:
            return value, True
        start = column.find(".", start + 1)
    return None, False


def listed(names: Iterable[str]) -> str:
    """Names for a message, those beyond the first few counted."""
    names = list(names)
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(map(plain_name, names[:_LISTED])) + more


def number(record: Record, column: str) -> float | None:
    """A finite number, or None where the cell is empty. Thousands' commas are read where they can be nothing else.

    Raises:
        DataError: something else is there.
    """
    value = record.values[column]
    if value is None:
        return None
    return _number(record, column, value)


def dollars(record: Record, column: str) -> bool | None:
    """Whether a cell is an amount of dollars by its sign; None where it is empty."""
    value = record.values[column]
    return None if value is None else isinstance(value, str) and DOLLAR in value


def price(record: Record, column: str) -> float | None:
    """As `number`, with a dollar sign passed over."""
    value = record.values[column]
    if not dollars(record, column):
        return number(record, column)
    text = value.strip()
    sign, amount = (text[0], text[1:]) if text[:1] in ("+", "-") else ("", text)
    amount = amount.removeprefix("US").removeprefix(DOLLAR).strip()
    if _GROUPED.fullmatch(amount):
        amount = amount.replace(",", "")  # who writes dollars so writes thousands so
    if not amount[:1].isdigit() and amount[:1] != ".":
        raise record.error(column, f"must be a number, got {quoted(value)}")
    return _number(record, column, sign + amount, value)


def _number(record: Record, column: str, value: Any, shown: Any = None) -> float:
    shown = value if shown is None else shown
    numeric = isinstance(value, str) or hasattr(value, "__float__")
    if isinstance(value, bool) or not numeric or (isinstance(value, str) and "_" in value):  # Python takes 1_000 for a number
        raise record.error(column, f"must be a number, got {quoted(shown)}")
    if isinstance(value, str) and _THOUSANDS.fullmatch(value.strip()):
        value = value.replace(",", "")
    try:
        result = float(value)
    except (ValueError, TypeError, ArithmeticError) as error:
        if isinstance(error, OverflowError):  # an integer of hundreds of digits
            raise record.error(column, "must be a finite number, got a far larger one") from None
        hint = ""
        if isinstance(value, str) and _GROUPED.fullmatch(value.strip()):
            hint = f"; write {value.strip().replace(',', '')}, or {value.strip().replace(',', '.')} if the comma is a decimal one"
        raise record.error(column, f"must be a number, got {quoted(shown)}{hint}") from None
    if not math.isfinite(result):
        raise record.error(column, f"must be a finite number, got {plain_name(str(shown))}; leave it empty where the policy did not run")
    return result


def text(record: Record, column: str) -> str:
    """A cell as text.

    Raises:
        DataError: it is empty, or holds a list, an object, or what cannot be written as UTF-8.
    """
    value = record.values[column]
    if value is None:
        raise record.error(column, "is empty, expected text")
    if isinstance(value, bytes):
        raise record.error(column, f"must be text, got {len(value)} bytes that are not UTF-8")
    if isinstance(value, list | tuple | dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise record.error(column, f"must be text, got {quoted(value)}")
    try:
        result = str(value)
    except ValueError:  # Python does not print integers of more than 4300 digits
        raise record.error(column, f"must be text, got {quoted(value)}") from None
    try:
        result.encode()
    except UnicodeEncodeError as error:
        raise record.error(column, f"must be text, got {result[error.start]!r} in it, which is only half of a character") from None
    return result


def form(value: str) -> str:
    """What is the same of two names that differ only in form: capitals, spaces, 1 and 1.0 and 01."""
    plain = " ".join(value.casefold().split())
    if re.fullmatch(r"[+-]?\d{1,300}(\.\d*)?(e[+-]?\d{1,3})?", plain):
        return repr(float(plain))
    return plain
