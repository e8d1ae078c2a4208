"""What a comparison leaves: `compare.json` in its folder, and files for a pull request or a CI server."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError, UsageError
from osel_sim.core.files import finite, is_partial, read_json, write_json, write_text
from osel_sim.formats.toml_types import quoted

SCHEMA_VERSION = 1
COMPARE = "compare.json"


def check_compare_folder(folder: Path, overwrite: bool) -> None:
    """Refuse an output folder that cannot be used, before any work is done.

    Raises:
        UsageError: a file, a folder with something else in it, or one with a comparison in it and `overwrite` off.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder} is a file; give a folder")
    if (folder / COMPARE).exists():
        if not overwrite:
            raise UsageError(f"--out {folder} holds a comparison; add --overwrite to replace it, or give another folder")
    elif folder.exists() and any(not is_partial(item) for item in folder.iterdir()):
        raise UsageError(f"--out {folder} is not empty and holds no {COMPARE}; give a new folder")


def check_file(flag: str, file: Path) -> None:
    """Refuse a folder where a file is to be written.

    Raises:
        UsageError: naming the flag.
    """
    if file.is_dir():
        raise UsageError(f"{flag} {file} is a folder; give a file")


def write_compare(folder: Path, result: Mapping[str, Any]) -> None:
    """Write `compare.json`, at once or not at all.

    Raises:
        UsageError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / COMPARE, finite({"schema_version": SCHEMA_VERSION, **result}))
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None


def read_compare(folder: Path) -> dict[str, Any]:
    """Read what `write_compare` wrote of a comparison.

    Raises:
        DataError: missing, a plan, damaged, of another version, or with parts that do not fit together; names the first place that is wrong.
    """
    from pydantic import ValidationError

    from osel_sim.formats.compare_schema import Comparison, faults

    file = folder / COMPARE
    if not file.is_file():
        raise DataError(f"{file} does not exist; python -m osel_sim.compare LOG LOG --out {folder} writes it")
    result = read_json(file)
    version = result.get("schema_version")
    if type(version) is not int or version != SCHEMA_VERSION:
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION}, got {quoted(version)}")
    if "plan" in result:
        raise DataError(f"{file} is a plan, which compares nothing: leave --plan out, and there is something to show")
    try:
        Comparison.model_validate(result)
    except ValidationError as error:
        raise DataError(f"{file} is damaged: {next(faults(error))}") from None
    return result


def write_report(flag: str, file: Path, text: str) -> None:
    """Write a text file and the folders above it. A pipe or a device, such as `/dev/stdout`, is written into, never replaced.

    Raises:
        UsageError: it cannot be written; names the flag.
    """
    try:
        if file.exists() and not file.is_file():
            with file.open("w", encoding="utf-8") as handle:
                handle.write(text)
            return
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, text)
    except OSError as error:
        raise UsageError(f"{flag} {file} cannot be written ({error.strerror})") from None
