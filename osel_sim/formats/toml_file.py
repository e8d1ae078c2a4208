"""Reads TOML files into pydantic models. One error tells all that is wrong with a file: where, and what would be right."""

import codecs
import functools
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from osel_sim.core.errors import ContentError
from osel_sim.core.shown import unprintable
from osel_sim.formats.schema_node import Node
from osel_sim.formats.toml_faults import faults_of, spelt_right
from osel_sim.formats.toml_types import LONGEST


def load_toml[T](model: type[T], file: Path, context: Mapping[str, Any] | None = None) -> T:
    """Read and check a file; arguments and errors are those of `check`."""
    return check(model, read_toml(file), file, context)


def read_toml(file: Path) -> dict[str, Any]:
    """A TOML file as plain data. A byte order mark, which some editors write, is passed over.

    Raises:
        ContentError: it cannot be read, is not UTF-8 or not TOML; with the line.
    """
    try:
        data = file.read_bytes().removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise ContentError(file, "file", f"cannot be read ({error.strerror})") from None
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ContentError(file, "TOML", "is UTF-16 text; save it as UTF-8")
    try:
        return tomllib.loads(data.decode())
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ContentError(file, "TOML", f"is not UTF-8 text (at line {line}); save it as UTF-8") from None
    except ValueError as error:  # a TOMLDecodeError, or an integer too long for Python
        raise ContentError(file, "TOML", str(error)) from None
    except RecursionError:
        raise ContentError(file, "TOML", "has lists or tables within each other too deep to be read") from None


def check[T](
    model: type[T], data: dict[str, Any], file: Path | str, context: Mapping[str, Any] | None = None, called: Callable[[str], str] = str
) -> T:
    """Check plain data.

    Args:
        model: a pydantic dataclass with the configuration `toml_types.TABLE`.
        file: what error messages begin with. Validators find it in their context, with the data as they are (`data`).
        context: what else validators want to know.
        called: what error messages call a key, such as `scene.region.object.x`.

    Raises:
        ContentError: naming the file and, for each fault, the key and what would be right.
    """
    adapter: TypeAdapter[T] = _adapter(model)  # type: ignore[arg-type]  # classes are hashable
    found = [(key, f"has a control character in it: {text[:LONGEST]!r}") for key, text in unprintable(data)]
    while True:
        try:
            result = adapter.validate_python(data, context={"file": file, "data": data, **(context or {})})
            break
        except ValidationError as error:
            schema = _schema(model)  # type: ignore[arg-type]
            misspelt, data = spelt_right(error, schema, data)
            found += misspelt or faults_of(error, schema)
            if not misspelt:
                break
    if found:
        first, *more = [(called(key), problem) for key, problem in found]
        raise ContentError(file, *first, *more)
    return result


@functools.cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    """A model's validator: making it takes ten times as long as validating a file."""
    return TypeAdapter(model)


@functools.cache
def _schema(model: Any) -> Node:
    schema = _adapter(model).json_schema()
    return Node(schema, schema)
