"""Parquet files of others: only the columns that are wanted are read, and whatever is wrong with a file is one line."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from osel_sim.core.arrays import check_rows
from osel_sim.core.errors import DataError, did_you_mean

PARQUET_ERRORS = (OSError, ValueError, LookupError, TypeError, OverflowError, ArithmeticError, NotImplementedError, RuntimeError, MemoryError)
"""What pyarrow raises for damaged files, and for types and values it cannot turn into others: its own errors are kinds of these."""


def parquet_columns(file: Path, wanted: Collection[str] = ()) -> list[str]:
    """The names of a file's columns.

    Raises:
        DataError: it cannot be read, claims more rows than it can hold, or has a column twice that is wanted.
    """
    try:
        names: list[str] = open_parquet(file).schema_arrow.names
        check_rows(file)
    except PARQUET_ERRORS as error:
        raise unreadable(file, error) from None
    twice = next((name for name in wanted if names.count(name) > 1), None)
    if twice is not None:
        raise DataError(f"{file}: column {twice!r} is there twice")
    return names


def open_parquet(file: Path) -> Any:
    """A file as `pyarrow.parquet.ParquetFile`, which refuses pages whose checksum is wrong.

    Raises:
        PARQUET_ERRORS: it cannot be read.
    """
    import pyarrow.parquet

    # To pyarrow a relative path that begins with `12:30/` or `a:b/` is an address.
    return pyarrow.parquet.ParquetFile(file.absolute(), page_checksum_verification=True)


def parquet_rows(file: Path) -> int:
    """How many rows a file has that can be read."""
    return int(open_parquet(file).metadata.num_rows)


def read_parquet(file: Path, columns: Sequence[str]) -> Any:
    """These columns of a file, as a `pyarrow.Table`. What others hold does not matter: it is not read.

    Raises:
        DataError: it cannot be read, or lacks a column.
    """
    names = parquet_columns(file, columns)
    for column in columns:
        if column not in names:
            raise DataError(f"{file}: there is no column {column!r}: {did_you_mean(column, names)}columns: {', '.join(names)}")
    try:
        # pyarrow takes the dots of a name for a path, which a column of the same beginning would match as well.
        return open_parquet(file).read(columns=list(columns)).select(list(columns))
    except PARQUET_ERRORS as error:
        raise unreadable(file, error) from None


def unreadable(file: Path, error: Exception) -> DataError:
    """What is wrong with a file, in one line, to be raised."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else (str(error).splitlines() or [""])[0]
    return DataError(f"{file}: is not a whole Parquet file ({reason[:200] or type(error).__name__})")
