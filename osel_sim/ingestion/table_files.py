"""The files of a table: names, patterns, and folders of parts."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import unquote

from osel_sim.core.errors import DataError

_CAPTURE = re.compile(r"\\\{([A-Za-z_][A-Za-z0-9_]*)\\\}")
_PARTITION = re.compile(r"([^=]+)=(.*)", re.DOTALL)
DELIMITERS = {".csv": ",", ".tsv": "\t"}
PARQUET = (".parquet", ".pq")
SUFFIXES = (*DELIMITERS, ".jsonl", ".ndjson", ".json", *PARQUET)


def find_files(base: Path, patterns: Sequence[str]) -> list[tuple[Path, dict[str, str]]]:
    """Files of the patterns, each once and in order, with what `{name}` stands for in each; `*` and `?` stand for any characters.

    A folder stands for the files in it, parts of one table as Spark, Dask and pandas write them; a folder `name=value` in it makes a column. Where
    there are Parquet files, they are the parts, and others tell something about them.

    Raises:
        DataError: a pattern has no file, or a file's format is not known.
    """
    found: dict[Path, dict[str, str]] = {}
    for pattern in patterns:
        matches: list[tuple[Path, dict[str, str]]] = [(base / Path(pattern).anchor, {})]
        for part in Path(pattern).relative_to(Path(pattern).anchor).parts:
            matches = [deeper for folder, captured in matches for deeper in _matches(folder, part, captured)]
        files = [one for path, captured in matches for one in _parts(path, captured)]
        if not files:
            where = base / pattern
            raise DataError(f"{where}: " + (f"is a folder without tables ({', '.join(SUFFIXES)})" if where.is_dir() else "there is no such file"))
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


def _parts(path: Path, captured: dict[str, str]) -> list[tuple[Path, dict[str, str]]]:
    """The file, or those of a folder."""
    if path.is_file():
        return [(path, captured)]
    found = list(_tables(path, captured)) if path.is_dir() else []
    return [one for one in found if one[0].suffix.lower() in PARQUET] or found


def _tables(folder: Path, captured: dict[str, str]) -> Iterator[tuple[Path, dict[str, str]]]:
    """Tables in a folder and in those within; what begins with a dot or an underscore says only how they were written."""
    for item in sorted(folder.iterdir()):
        if item.name.startswith((".", "_")):
            continue
        if item.is_dir():
            partition = _PARTITION.fullmatch(item.name)
            value = unquote(partition[2]) if partition else ""
            more = {partition[1]: "" if value == "__HIVE_DEFAULT_PARTITION__" else value} if partition else {}
            yield from _tables(item, {**captured, **more})
        elif item.suffix.lower() in SUFFIXES:
            yield item, captured
