"""Reading CSV, TSV, JSON lines and Parquet as rows that know where they came from; every complaint names file and row.

Parquet is read by pyarrow, text by the standard library's csv and json. pandas 2.3 (either of its CSV engines) and pyarrow's CSV reader were tried
on the tables that the tests refuse, and accept some of them as something else: pandas fills up a row that was cut with NaN, takes a first row that
is too long for an index, and renames a column that is there twice; its fast engine drops what follows a NUL, and it and pyarrow take damaged quotes
as text. pandas' JSON reader keeps the last of two equal keys and makes integers floats where a row lacks them. None says on which line a row
begins. A wrong outcome that looks right is worse than a slow reader.
"""

import csv
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.arrays import check_rows
from osel_sim.core.errors import DataError, did_you_mean
from osel_sim.ingestion.columns import Columns, Join, flag

_CAPTURE = re.compile(r"\\\{([A-Za-z_][A-Za-z0-9_]*)\\\}")
_LONGEST_FIELD = 64 * 1024 * 1024
DELIMITERS = {".csv": ",", ".tsv": "\t"}
SUFFIXES = (*DELIMITERS, ".jsonl", ".ndjson", ".parquet")


@dataclass(frozen=True)
class Record:
    """One row of a table.

    Attributes:
        number: from 1 on, the header not counted.
        line: where it begins in a text file; None in Parquet.
        values: column -> text, number, bool or None. An empty cell is None.
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
        return DataError(f"{self.where}, column {column!r}: {problem}")


def read_tables(columns: Columns) -> list[Record]:
    """All rows of the tables' files in the order of the files' names, with the joined columns.

    Raises:
        DataError: a file is missing, empty, cut, of a wrong form, or lacks a column that is named.
    """
    records = _read_all(columns.base, columns.files)
    for join in columns.joins:
        records = _joined(records, _read_all(columns.base, join.files), join)
    there = records[0].values.keys()
    for column, key in columns.needed.items():
        if column not in there:
            who = f"{flag(key)} names" if columns.from_flags else f"{columns.file} names as {key}"
            raise DataError(f"{records[0].file}: there is no column {column!r}, which {who}: {_instead(records[0], column)}")
    return records


def find_files(base: Path, patterns: Sequence[str]) -> list[tuple[Path, dict[str, str]]]:
    """Files of the patterns, each once and in order, with what `{name}` stands for in each; `*` and `?` stand for any characters.

    Raises:
        DataError: a pattern has no file, or a file's format is not known.
    """
    found: dict[Path, dict[str, str]] = {}
    for pattern in patterns:
        matches: list[tuple[Path, dict[str, str]]] = [(base / Path(pattern).anchor, {})]
        for part in Path(pattern).relative_to(Path(pattern).anchor).parts:
            matches = [deeper for folder, captured in matches for deeper in _matches(folder, part, captured)]
        files = [(file, captured) for file, captured in matches if file.is_file()]
        if not files:
            raise DataError(f"{base / pattern}: there is no such file")
        for file, captured in files:
            if file.suffix.lower() not in SUFFIXES:
                raise DataError(f"{file}: unknown format {file.suffix!r}, known: {', '.join(SUFFIXES)}")
            found.setdefault(file, captured)
    return list(found.items())


def _matches(folder: Path, part: str, captured: dict[str, str]) -> Iterator[tuple[Path, dict[str, str]]]:
    """What one part of a pattern stands for in a folder."""
    if not re.search(r"[*?{]", part):
        if (folder / part).exists():
            yield folder / part, captured
        return
    name = re.escape(part).replace(r"\*", ".*").replace(r"\?", ".")
    expression = re.compile(_CAPTURE.sub(r"(?P<\1>.+)", name), re.DOTALL)
    for item in sorted(folder.glob("*")):
        match = expression.fullmatch(item.name)
        if match and all(captured.get(key, value) == value for key, value in match.groupdict().items()):
            yield item, {**captured, **match.groupdict()}


def _read_all(base: Path, patterns: Sequence[str]) -> list[Record]:
    records: list[Record] = []
    first: Record | None = None
    for file, captured in find_files(base, patterns):
        rows = _read(file)
        clash = captured.keys() & rows[0].values.keys()
        if clash:
            raise DataError(f"{file}: column {min(clash)!r} is in the table and in the pattern of file names; name the pattern's part otherwise")
        if first is None:
            first = rows[0]
        different = first.values.keys() ^ {**rows[0].values, **captured}.keys() if records else set()
        if different:
            raise DataError(f"{file}: column {min(different)!r} is only in one of this file and {first.file}; their columns must be the same")
        records += [Record(row.file, row.number, row.line, {**row.values, **captured}) for row in rows]
        first = records[0]
    return records


def _read(file: Path) -> list[Record]:
    """The rows of one file, at least one."""
    suffix = file.suffix.lower()
    try:
        if suffix == ".parquet":
            rows = list(_parquet(file))
        elif suffix in DELIMITERS:
            rows = list(_delimited(file, DELIMITERS[suffix]))
        else:
            rows = list(_json_lines(file))
    except UnicodeDecodeError as error:
        raise DataError(f"{file}: is not UTF-8 text ({error.reason} at byte {error.start})") from None
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror or error})") from None
    if not rows:
        raise DataError(f"{file}: has no rows")
    return rows


def _delimited(file: Path, delimiter: str) -> Iterator[Record]:
    before = csv.field_size_limit(_LONGEST_FIELD)  # the default refuses texts of more than 128 KiB
    header, start = None, 1
    try:
        with file.open(encoding="utf-8-sig", newline="") as handle:
            reader = csv.reader(handle, delimiter=delimiter, strict=True)
            header = next(reader, None)
            if header is None:
                raise DataError(f"{file}: is empty, expected a header with the columns' names")
            for name in header:
                if not name or header.count(name) > 1:
                    raise DataError(f"{file}: line 1: " + (f"column {name!r} is there twice" if name else "a column has no name"))
            start, number = reader.line_num + 1, 0
            for fields in reader:
                if fields:  # a blank line is none
                    number += 1
                    if len(fields) != len(header):
                        raise DataError(
                            f"{file}, row {number} (line {start}): has {len(fields)} fields, the header has {len(header)}; "
                            "the file was cut, or a quote is missing" + _other_delimiter(file, header)
                        )
                    yield Record(file, number, start, {name: text or None for name, text in zip(header, fields, strict=True)})
                start = reader.line_num + 1
    except csv.Error as error:
        raise DataError(
            f"{file}: the row that begins at line {start} cannot be read ({error}); "
            f"the file was cut, a quote is wrong, or it is not separated by {delimiter!r}"
        ) from None
    finally:
        csv.field_size_limit(before)


def _json_lines(file: Path) -> Iterator[Record]:
    rows: list[tuple[int, dict[str, Any]]] = []
    with file.open(encoding="utf-8-sig") as handle:
        for line, text in enumerate(handle, start=1):
            if not text.strip():
                continue
            try:
                value = json.loads(text, object_pairs_hook=_without_repetition)
            except DataError as error:
                raise DataError(f"{file}, line {line}: {error}") from None
            except (ValueError, RecursionError) as error:
                raise DataError(f"{file}, line {line}: is not JSON ({error}); every line must be one object, the file may have been cut") from None
            if not isinstance(value, dict):
                raise DataError(f"{file}, line {line}: must be an object, got {type(value).__name__}")
            rows.append((line, value))
    # A key that is left out is an empty cell.
    columns = list(dict.fromkeys(name for _, row in rows for name in row))
    for number, (line, row) in enumerate(rows, start=1):
        yield Record(file, number, line, {name: _cell(row.get(name)) for name in columns})


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise DataError(f"key {name!r} is there twice")
        result[name] = value
    return result


def _parquet(file: Path) -> Iterator[Record]:
    import pyarrow
    import pyarrow.parquet

    try:
        names = pyarrow.parquet.read_schema(file).names
        check_rows(file)
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise DataError(f"{file}: column {twice!r} is there twice")
        rows = pyarrow.parquet.read_table(file, page_checksum_verification=True).to_pylist()
    except (pyarrow.ArrowException, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{file}: is not a whole Parquet file ({reason})") from None
    for number, row in enumerate(rows, start=1):
        yield Record(file, number, None, {name: _cell(value) for name, value in row.items()})


def _joined(records: list[Record], others: list[Record], join: Join) -> list[Record]:
    for side in (records[0], others[0]):
        if join.on not in side.values:
            raise DataError(f"{side.file}: there is no column {join.on!r} to join on: {_instead(side, join.on)}")
    clash = (records[0].values.keys() & others[0].values.keys()) - {join.on}
    if clash:
        raise DataError(f"{others[0].file}: column {min(clash)!r} is in {records[0].file} as well; rename one; only {join.on!r} may be in both")
    by_key: dict[str, Record] = {}
    for other in others:
        key = text(other, join.on)
        if key in by_key:
            raise other.error(join.on, f"{key!r} is in row {by_key[key].number} of {by_key[key].file} already; a joined table has one row for each")
        by_key[key] = other
    result = []
    for record in records:
        match = by_key.get(text(record, join.on))
        if match is None:
            raise record.error(join.on, f"{record.values[join.on]!r} is not in {others[0].file}")
        result.append(Record(record.file, record.number, record.line, {**match.values, **record.values}))
    return result


def _instead(record: Record, column: str) -> str:
    """What may have been meant by a column that is not there."""
    columns = list(record.values)
    return f"{did_you_mean(column, columns)}columns: {', '.join(columns)}" + _other_delimiter(record.file, columns, column)


def _other_delimiter(file: Path, columns: Sequence[str], missing: str | None = None) -> str:
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


def _cell(value: Any) -> Any:
    """A cell as it was read: an empty one is None, and bytes are the text they encode, if they do."""
    if isinstance(value, bytes):
        try:
            value = value.decode()
        except UnicodeDecodeError:
            return value
    return None if value == "" else value


def number(record: Record, column: str) -> float | None:
    """A finite number, or None where the cell is empty.

    Raises:
        DataError: something else is there.
    """
    value = record.values[column]
    if value is None:
        return None
    numeric = isinstance(value, str) or hasattr(value, "__float__")
    if isinstance(value, bool) or not numeric or (isinstance(value, str) and "_" in value):  # Python takes 1_000 for a number
        raise record.error(column, f"must be a number, got {value!r}")
    try:
        result = float(value)
    except ValueError:
        raise record.error(column, f"must be a number, got {value!r}") from None
    except OverflowError:  # an integer of hundreds of digits
        raise record.error(column, "must be a finite number, got a far larger one") from None
    if not math.isfinite(result):
        raise record.error(column, f"must be a finite number, got {value}; leave it empty where the policy did not run")
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
    if isinstance(value, list | dict) or (isinstance(value, float) and not math.isfinite(value)):
        raise record.error(column, f"must be text, got {value!r}")
    result = str(value)
    try:
        result.encode()
    except UnicodeEncodeError as error:
        raise record.error(column, f"must be text, got {result[error.start]!r} in it, which is only half of a character") from None
    return result
