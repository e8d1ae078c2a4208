"""Tables as CSV for others to open, spreadsheets among them."""

import csv
import io
import re
from collections.abc import Iterable, Sequence

_FORMULA = re.compile(r"\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)")


def to_csv(rows: Iterable[Sequence[object]]) -> str:
    """Rows of cells, the headings first. Numbers have all their digits, and what is None is empty.

    A text that a spreadsheet would take for a formula (it begins with = + - @, a tab or a line end, and is no number) gets a single quote before it:
    names come from tables of others (https://owasp.org/www-community/attacks/CSV_Injection).
    """
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([_harmless(cell) for cell in row] for row in rows)
    return buffer.getvalue()


def _harmless(cell: object) -> object:
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) and not _NUMBER.fullmatch(cell) else cell
