"""Files: JSON at once or not at all, and digests."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError


def digest(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder with their names."""
    total = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            total.update(file.relative_to(path).as_posix().encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def write_json(file: Path, data: dict[str, Any]) -> None:
    """Indented JSON, at once or not at all."""
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
    os.replace(partial, file)


def read_json(file: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        DataError: the file is missing or holds something else.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{file} cannot be read as JSON ({error})") from None
    if not isinstance(data, dict):
        raise DataError(f"{file}: expected an object, got {type(data).__name__}")
    return data
