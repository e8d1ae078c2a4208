"""Files: written whole or not at all, read as what they should be, and their digests."""

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError

_PARTIAL = ".partial"


@contextlib.contextmanager
def atomic(file: Path, *, sync: bool = False, shared: bool = False) -> Iterator[Path]:
    """Write a file under another name and put it in place when the block ends, so that a reader or a killed process finds the old one or the new.

    Yields the path to write to, in the same folder. If the block raises, what was written is removed and the old file stays.

    Args:
        sync: wait until the file and its name are on disk, so that they survive a power cut.
        shared: several processes may write the file at once; each writes under a name of its own.
    """
    partial = _partial(file, f".{os.getpid()}" if shared else "")
    try:
        yield partial
        if sync:
            _sync(partial)
        os.replace(partial, file)
        if sync:
            _sync(file.parent)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Make a folder under another name and put it in place of the old one when the block ends; if the block raises, the old one stays.

    Yields the path to make, beside `folder`; nothing is there yet.
    """
    partial = _partial(folder)
    shutil.rmtree(partial, ignore_errors=True)
    try:
        yield partial
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextlib.contextmanager
def atomic_files(folder: Path) -> Iterator[Path]:
    """Make several files of a folder in an empty one beside it; they replace those of the same name when the block ends, each at once.

    Other files of the folder stay. If the block raises, so do all of them.
    """
    partial = _partial(folder)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        folder.mkdir(exist_ok=True)
        for file in sorted(partial.iterdir()):
            file.replace(folder / file.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def is_partial(path: Path) -> bool:
    """Whether a path is what a killed process left of a file or folder that it was writing."""
    return path.name.startswith(".") and path.name.endswith(_PARTIAL)


def write_bytes(file: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a file, at once or not at all."""
    with atomic(file, sync=sync) as partial:
        partial.write_bytes(content)


def write_text(file: Path, text: str) -> None:
    """Write a text file in UTF-8, at once or not at all."""
    write_bytes(file, text.encode())


def write_json(file: Path, data: dict[str, Any]) -> None:
    """Write indented JSON, at once or not at all.

    Raises:
        ValueError: a NaN or infinity, which JSON does not have; `finite` makes None of them.
    """
    write_text(file, json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def finite(data: Any) -> Any:
    """Plain data with None instead of numbers that JSON does not have (NaN and infinities)."""
    if isinstance(data, dict):
        return {key: finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


def read_json(file: Path, hint: str = "") -> dict[str, Any]:
    """Read a JSON object.

    Args:
        hint: what to do if the file is not there; ends the message.

    Raises:
        DataError: the file is missing or holds something else.
    """
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DataError(f"{file} cannot be read as JSON ({error})" + (f"; {hint}" if hint else "")) from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file} cannot be read as JSON ({error})") from None
    if not isinstance(data, dict):
        raise DataError(f"{file}: expected an object, got {type(data).__name__}")
    return data


def digest(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder with their names, as `run.json` has it."""
    total = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            total.update(file.relative_to(path).as_posix().encode() + b"\0" + bytes.fromhex(file_digest(file)))
    return total.hexdigest()


def file_digest(file: Path) -> str:
    """SHA-256 of a file's content alone, as sha256sum prints it."""
    with file.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def content_digest(*parts: str | bytes) -> str:
    """SHA-256 of texts (as UTF-8) and bytes, one after another."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() if isinstance(part, str) else part)
    return total.hexdigest()


def _partial(path: Path, suffix: str = "") -> Path:
    return path.with_name(f".{path.name}{suffix}{_PARTIAL}")


def _sync(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
