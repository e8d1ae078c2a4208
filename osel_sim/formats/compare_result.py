"""What a comparison leaves: `compare.json` in its folder, and files for a pull request or a CI server."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from osel_sim.core.errors import UsageError
from osel_sim.core.files import finite, is_partial, write_json, write_text

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


def write_report(flag: str, file: Path, text: str) -> None:
    """Write a text file and the folders above it.

    Raises:
        UsageError: it cannot be written; names the flag.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, text)
    except OSError as error:
        raise UsageError(f"{flag} {file} cannot be written ({error.strerror})") from None
