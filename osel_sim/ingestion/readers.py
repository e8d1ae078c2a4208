"""Reading tables as rows that know where they came from: only the columns that are named are read, and every complaint names file and row.

Parquet is read by pyarrow, text by the standard library's csv and json. pandas 2.3 (either of its CSV engines) and pyarrow's CSV reader were tried
on the tables that the tests refuse, and accept some of them as something else: pandas fills up a row that was cut with NaN, takes a first row that
is too long for an index, and renames a column that is there twice; its fast engine drops what follows a NUL, and it and pyarrow take damaged quotes
as text. pandas' JSON reader keeps the last of two equal keys and makes integers floats where a row lacks them. None says on which line a row
begins. A wrong outcome that looks right is worse than a slow reader.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError, did_you_mean
from osel_sim.core.parquet import PARQUET_ERRORS, parquet_columns, parquet_rows, read_parquet
from osel_sim.formats.toml_types import quoted
from osel_sim.ingestion.columns import Columns, flag
from osel_sim.ingestion.records import Record, cell, form, listed, text
from osel_sim.ingestion.table_files import DELIMITERS, PARQUET, find_files
from osel_sim.ingestion.text_tables import other_delimiter, read_delimited, read_json_rows


@dataclass(frozen=True)
class Table:
    """The rows of all files of a table.

    Attributes:
        columns: of its first file, those that are not wanted included.
        there: the wanted ones that it has.
        records: at least one.
    """

    columns: Sequence[str]
    there: Collection[str]
    records: list[Record]

    @property
    def file(self) -> Path:
        """The first one."""
        return self.records[0].file


def read_tables(columns: Columns) -> list[Record]:
    """All rows of the tables' files in the order of the files' names, with the joined columns.

    Raises:
        DataError: a file is missing, empty, cut, of a wrong form, or lacks a column that is named.
    """
    needed = columns.needed
    wanted = {*needed, *(join.on for join in columns.joins)}
    table = _read_all(columns.base, columns.files, wanted)
    there, records = set(table.there), table.records
    for join in columns.joins:
        other = _read_all(columns.base, join.files, wanted)
        for side in (table, other):
            if join.on not in side.there and (side is other or join.on not in there):
                raise DataError(f"{side.file}: there is no column {quoted(join.on)} to join on: {_instead(side, join.on)}")
        clash = (there & set(other.there)) - {join.on}
        if clash:
            raise DataError(
                f"{other.file}: column {quoted(min(clash))} is in {table.file} as well; rename one; only {quoted(join.on)} may be in both"
            )
        there |= set(other.there)
        records = _joined(records, other, join.on)
    for column, key in needed.items():
        if column not in there:
            who = f"{flag(key)} names" if columns.from_flags else f"{columns.file} names as {key}"
            raise DataError(f"{table.file}: there is no column {quoted(column)}, which {who}: {_instead(table, column)}")
    return records


def read_named(file: Path, needed: Collection[str], optional: Collection[str] = ()) -> tuple[set[str], list[Record]]:
    """Rows of one table by columns whose names are fixed, and which of them it has.

    Raises:
        DataError: as `read_tables`.
    """
    table = _read_all(Path(), [str(file)], {*needed, *optional})
    for column in needed:
        if column not in table.there:
            raise DataError(f"{file}: there is no column {quoted(column)}: {_instead(table, column)}")
    return set(table.there), table.records


def first_columns(base: Path, patterns: Sequence[str]) -> list[str]:
    """The columns of a table's first file.

    Raises:
        DataError: there is no such file, or it cannot be read.
    """
    file, captured = find_files(base, patterns)[0]
    return [*_read(file, ())[0], *captured]


def _read_all(base: Path, patterns: Sequence[str], wanted: Collection[str]) -> Table:
    records: list[Record] = []
    parts: list[tuple[Path, list[str], set[str]]] = []
    files = find_files(base, patterns)
    for file, captured in files:
        columns, rows = _read(file, wanted)
        if not rows:
            continue  # writers of parts leave empty ones
        clash = captured.keys() & set(columns)
        if clash:
            raise DataError(
                f"{file}: column {quoted(min(clash))} is in the table and in the pattern of file names; name the pattern's part otherwise"
            )
        told = {name: cell(value) for name, value in captured.items() if name in wanted}
        parts.append((file, [*columns, *captured], {*rows[0].values, *told}))
        records += [Record(row.file, row.number, row.line, {**row.values, **told}) for row in rows]
    if not records:
        raise DataError(f"{files[0][0]}: has no rows" + (f", nor have {len(files) - 1} other files" if len(files) > 1 else ""))
    there = set().union(*(part[2] for part in parts))
    for file, columns, own in parts:
        lacking = there - own
        if lacking and (file.suffix.lower() in DELIMITERS or file.suffix.lower() in PARQUET):
            first = next(other for other, _, names in parts if min(lacking) in names)
            raise DataError(f"{file}: column {quoted(min(lacking))} is missing, and is in {first}: columns: {listed(columns)}")
    for record in records:
        for name in there - record.values.keys():
            record.values[name] = None  # a key that is left out of a whole file of JSON
    return Table(parts[0][1], there, records)


def _read(file: Path, wanted: Collection[str]) -> tuple[list[str], list[Record]]:
    """Columns and rows of one file."""
    suffix = file.suffix.lower()
    try:
        if suffix in PARQUET:
            columns, rows = _parquet(file, wanted)
        elif suffix in DELIMITERS:
            columns, rows = read_delimited(file, wanted)
        else:
            columns, rows = read_json_rows(file, wanted)
    except UnicodeDecodeError as error:
        raise DataError(f"{file}: is not UTF-8 text ({error.reason} at byte {error.start})") from None
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror or error})") from None
    return columns, rows


def _parquet(file: Path, wanted: Collection[str]) -> tuple[list[str], list[Record]]:
    names = parquet_columns(file, wanted)
    outer = {name: next((head for head, _ in _splits(name) if head in names), None) for name in wanted}
    table = read_parquet(file, list(dict.fromkeys(name for name in outer.values() if name is not None)))
    found: dict[str, list[Any]] = {}
    for name, head in outer.items():
        column = None if head is None else _inner(table[head], name[len(head) + 1 :])
        if column is not None:
            found[name] = _cells(file, name, column)
    return names, [Record(file, row + 1, None, {name: cell(values[row]) for name, values in found.items()}) for row in range(parquet_rows(file))]


def _splits(name: str) -> Iterator[tuple[str, str]]:
    """A name with nothing behind it, then cut in two at each of its dots, the longest part first."""
    yield name, ""
    for at in sorted((index for index, letter in enumerate(name) if letter == "."), reverse=True):
        yield name[:at], name[at + 1 :]


def _inner(column: Any, path: str) -> Any:
    """A field within a struct, `a.b`; None where there is none of that name."""
    import pyarrow
    import pyarrow.compute

    if not path:
        return column
    fields = [field.name for field in column.type] if pyarrow.types.is_struct(column.type) else []
    for head, rest in _splits(path):
        if head in fields and (found := _inner(pyarrow.compute.struct_field(column, fields.index(head)), rest)) is not None:
            return found
    return None


def _cells(file: Path, name: str, column: Any) -> list[Any]:
    """A column's values; where one cannot be had (a date beyond Python's, text that is no UTF-8), its row is named."""
    try:
        values: list[Any] = column.to_pylist()
    except PARQUET_ERRORS:
        for row, value in enumerate(column, start=1):
            try:
                value.as_py()
            except PARQUET_ERRORS as error:
                reason = " ".join(str(error).split())[:200] or type(error).__name__
                raise DataError(f"{file}, row {row}, column {quoted(name)}: cannot be read ({reason}); its type is {column.type}") from None
        raise
    return values


def _joined(records: list[Record], others: Table, on: str) -> list[Record]:
    by_key: dict[str, Record] = {}
    for other in others.records:
        key = text(other, on)
        if key in by_key:
            raise other.error(on, f"{quoted(key)} is in row {by_key[key].number} of {by_key[key].file} already; a joined table has one row for each")
        by_key[key] = other
    result = []
    forms: Mapping[str, str] | None = None
    for record in records:
        match = by_key.get(text(record, on))
        if match is None:
            forms = forms or {form(key): key for key in by_key}
            near = forms.get(form(text(record, on)))
            hint = f"; it has {quoted(near)}, which differs only in form: write both alike" if near is not None else ""
            raise record.error(on, f"{quoted(record.values[on])} is not in {others.file}{hint}")
        result.append(Record(record.file, record.number, record.line, {**match.values, **record.values}))
    return result


def _instead(table: Table, column: str) -> str:
    """What may have been meant by a column that is not there."""
    near = did_you_mean(column[:200], [name for name in table.columns if len(name) <= 200])
    return f"{near}columns: {listed(table.columns)}" + other_delimiter(table.file, table.columns, column)
