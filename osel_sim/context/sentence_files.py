"""What the files of a sentence-transformers model name, looked at before it is loaded: the library imports the classes that they name.

Versions before 6 import any class of `modules.json`; later ones ask for `trust_remote_code` first, and still take whatever attribute of a module of
theirs is named.
"""

import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from osel_sim.core.errors import CheckpointError
from osel_sim.core.trust import ForeignCodeError, find_class

MODULES = "modules.json"
MAX_BYTES = 16 << 20  # of a JSON file that is read
MAX_FILES = 200
_VOCABULARIES = ("tokenizer.json", "vocab.json")  # many megabytes, and they name no classes
_PACKAGES = ("sentence_transformers",)


def check_sentence_model(folder: Path) -> None:
    """Whether all classes that the JSON files of a model name may be imported, and its modules lie within the folder.

    Raises:
        CheckpointError: naming the file, what it names and why not.
    """
    files = [file for file in sorted(folder.rglob("*.json")) if file.name not in _VOCABULARIES]
    if len(files) > MAX_FILES:
        raise CheckpointError(f"{folder}: has {len(files)} JSON files: no sentence-transformers model has so many")
    for file in files:
        data = _read(file)
        try:
            if file.name == MODULES:  # of a model within the model, too
                _check_modules(data, folder)
            for key, path in _named(data):
                _check_class(key, path, folder)
        except ForeignCodeError as error:
            raise ForeignCodeError(f"{file}: {error}") from None
        except (CheckpointError, RecursionError) as error:
            raise CheckpointError(f"{file}: {error}") from None


def _check_modules(data: Any, folder: Path) -> None:
    from torch import nn

    if not isinstance(data, list):
        raise CheckpointError("must be a list of modules")
    for number, module in enumerate(data):
        path = module.get("path") if isinstance(module, dict) else None
        if not isinstance(path, str) or PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts or "\\" in path:
            raise CheckpointError(f"module {number} has the path {str(path)[:80]!r}, which must be a folder within this one")
        try:
            find_class(module.get("type"), _PACKAGES, nn.Module, folder)
        except ForeignCodeError as error:
            raise ForeignCodeError(f"module {number} {error}") from None


def _check_class(key: str, path: str, folder: Path) -> None:
    from torch import nn

    if key == "tokenizer_class":
        find_class(path, _PACKAGES, object, folder)
    else:
        find_class(path, ("torch.nn",) if key.startswith("activation") else _PACKAGES, nn.Module, folder)


def _named(data: Any) -> Iterator[tuple[str, str]]:
    """Keys and paths of what the library would import. A name without a dot is one that transformers looks up."""
    if isinstance(data, dict):
        for key, value in data.items():
            if key == "types" and isinstance(value, dict):
                yield from ((key, path) for path in value.values())
            elif key in ("activation_function", "activation_fn", "tokenizer_class") and isinstance(value, str) and "." in value:
                yield key, value
            else:
                yield from _named(value)
    elif isinstance(data, list):
        for value in data:
            yield from _named(value)


def _read(file: Path) -> Any:
    try:
        if file.stat().st_size > MAX_BYTES:
            raise CheckpointError(f"{file}: has {file.stat().st_size} bytes, and no more than {MAX_BYTES} are read")
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: cannot be read as JSON ({str(error)[:120]})") from None
