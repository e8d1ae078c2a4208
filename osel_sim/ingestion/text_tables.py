"""CSV, TSV and JSON as rows that know their line. Only the columns that are wanted are kept."""

import csv
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.records import Record, cell, within
from osel_sim.ingestion.table_files import DELIMITERS

_LONGEST_FIELD = 64 * 1024 * 1024


def read_delimited(file: Path, wanted: Collection[str]) -> tuple[list[str], list[Record]]:
    """Columns and rows of a CSV or TSV file. Columns without a name, as of an index, are passed over.

    Raises:
        DataError: it is empty, cut, or has a wanted column twice.
    """
    delimiter = DELIMITERS[file.suffix.lower()]
    before = csv.field_size_limit(_LONGEST_FIELD)  # the default refuses texts of more than 128 KiB
    start, records = 1, []
    try:
        with file.open(encoding="utf-8-sig", newline="") as handle:
            reader = csv.reader(handle, delimiter=delimiter, strict=True)
            header = next(reader, None)
            if header is None:
                raise DataError(f"{file}: is empty, expected a header with the columns' names")
            twice = next((name for name in header if name in wanted and header.count(name) > 1), None)
            if twice is not None:
                raise DataError(f"{file}: line 1: column {quoted(twice)} is there twice")
            kept = [(index, name) for index, name in enumerate(header) if name in wanted]
            start, number = reader.line_num + 1, 0
            for fields in reader:
                if fields:  # a blank line is none
                    number += 1
                    if len(fields) != len(header):
                        raise DataError(
                            f"{file}, row {number} (line {start}): has {len(fields)} fields, the header has {len(header)}; "
                            "the file was cut, or a quote is missing" + other_delimiter(file, header)
                        )
                    records.append(Record(file, number, start, {name: cell(fields[index]) for index, name in kept}))
                start = reader.line_num + 1
    except csv.Error as error:
        raise DataError(
            f"{file}: the row that begins at line {start} cannot be read ({error}); "
            f"the file was cut, a quote is wrong, or it is not separated by {delimiter!r}"
        ) from None
    finally:
        csv.field_size_limit(before)
    return [name for name in header if name], records


def read_json_rows(file: Path, wanted: Collection[str]) -> tuple[list[str], list[Record]]:
    """Columns and rows of JSON: an object a line, or one array of objects (which may be all that an object holds, as `{"data": [...]}`).

    A key that is left out is an empty cell. `scores.model` is what an object `scores` has under `model`.

    Raises:
        DataError: it is something else.
    """
    rows = list(_objects(file))
    columns = list(dict.fromkeys(name for _, row in rows for name in _names(row)))
    there = {name for name in wanted if any(within(row, name)[1] for _, row in rows)}
    records = [
        Record(file, number, line, {name: cell(within(row, name)[0]) for name in wanted if name in there})
        for number, (line, row) in enumerate(rows, start=1)
    ]
    return columns, records


def _objects(file: Path) -> Iterator[tuple[int | None, dict[str, Any]]]:
    with file.open(encoding="utf-8-sig") as handle:
        text = handle.read()
    rows = _array(file, text)
    if rows is not None:
        for number, value in enumerate(rows, start=1):
            if not isinstance(value, dict):
                raise DataError(f"{file}, row {number}: must be an object, got {type(value).__name__}")
            yield None, value
        return
    for line, part in enumerate(text.split("\n"), start=1):
        if not part.strip():
            continue
        try:
            value = json.loads(part, object_pairs_hook=_without_repetition)
        except DataError as error:
            raise DataError(f"{file}, line {line}: {error}") from None
        except (ValueError, RecursionError) as error:
            raise DataError(
                f"{file}, line {line}: is not JSON ({_reason(error)}); every line must be one object, or the file one array of objects; "
                "it may have been cut"
            ) from None
        if not isinstance(value, dict):
            raise DataError(f"{file}, line {line}: must be an object, got {type(value).__name__}")
        yield line, value


def _array(file: Path, text: str) -> list[Any] | None:
    """The array that a file holds, if it is no file of lines."""
    start = text.lstrip()[:1]
    if start not in ("[", "{") or (start == "{" and file.suffix.lower() != ".json"):
        return None
    try:
        value = json.loads(text, object_pairs_hook=_without_repetition)
    except DataError as error:
        if start == "{":
            return None  # of lines it can be told on which
        raise DataError(f"{file}: {error}") from None
    except (ValueError, RecursionError) as error:
        if start == "{":
            return None
        at = f"line {error.lineno}: " if isinstance(error, json.JSONDecodeError) else ""
        raise DataError(f"{file}, {at}is not JSON ({_reason(error)}); the file may have been cut") from None
    if isinstance(value, list):
        whole = file.suffix.lower() == ".json" or all(isinstance(row, dict) for row in value)
        return value if whole else None
    arrays = [part for part in value.values() if isinstance(part, list) and part and all(isinstance(row, dict) for row in part)]
    return arrays[0] if len(arrays) == 1 else None


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _names(row: dict[str, Any], before: str = "") -> Iterator[str]:
    """The names of an object's values, those within others with dots."""
    for name, value in row.items():
        if isinstance(value, dict) and before.count(".") < 3:
            yield from _names(value, f"{before}{name}.")
        else:
            yield f"{before}{name}"


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise DataError(f"key {quoted(name)} is there twice")
        result[name] = value
    return result


def other_delimiter(file: Path, columns: Sequence[str], missing: str | None = None) -> str:
    """A hint where a column's name looks like a header with another delimiter, being the only one or having the missing column in it."""
    own = DELIMITERS.get(file.suffix.lower())
    for name in columns if own else ():
        for delimiter in (";", "\t", "|", ","):
            parts = [part.strip() for part in name.split(delimiter)]
            if delimiter != own and len(parts) > 1 and (len(columns) == 1 or missing in parts):
                right = next((suffix for suffix, other in DELIMITERS.items() if other == delimiter), None)
                way = f"name it {right}" if right else "write it with one of these"
                return f"; it seems to be separated by {delimiter!r}, but a .csv is by ',' and a .tsv by '\\t': {way}"
    return ""
