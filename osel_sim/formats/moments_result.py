"""What a replay of a table of moments leaves in its folder: `moments.json`, and tables as CSV. `moments.json` is written last."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from osel_sim.core.csv_text import to_csv
from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.files import read_json, write_json, write_text
from osel_sim.core.interrupts import uninterrupted

SCHEMA_VERSION = 1
MOMENTS_RESULT = "moments.json"
_NEEDED = ("policies", "calls", "instances", "reward", "margin", "arms", "oracles", "gains", "timeline", "verdict", "log")


def write_moments_result(folder: Path, result: Mapping[str, Any], tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Write a result, over one that may be there. Each file is written whole or not at all, and Ctrl-C waits until all are.

    Args:
        tables: file name without ending -> rows, each a mapping of the same columns.

    Raises:
        UsageError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with uninterrupted():
            for name, rows in tables.items():
                headings = list(rows[0]) if rows else []
                write_text(folder / f"{name}.csv", to_csv([headings, *([row.get(key) for key in headings] for row in rows)]))
            write_json(folder / MOMENTS_RESULT, {"schema_version": SCHEMA_VERSION, **result})
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None


def read_moments_result(folder: Path) -> dict[str, Any]:
    """Read `moments.json`.

    Raises:
        DataError: missing, damaged, or of another schema.
    """
    file = folder / MOMENTS_RESULT
    result = read_json(file)
    if result.get("schema_version") != SCHEMA_VERSION:
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION}, got {result.get('schema_version')}")
    if missing := [name for name in _NEEDED if name not in result]:
        raise DataError(f"{file}: not what a replay of moments writes, it has no {missing[0]}")
    return result
