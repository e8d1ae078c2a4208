"""Reading a TOML table key by key; every complaint names file, key and what would be right."""

import difflib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from osel_sim.core.errors import ContentError
from osel_sim.core.shown import unprintable


class Table:
    """A TOML table that remembers which keys were read, so that left-over (misspelt) keys are refused."""

    def __init__(self, data: dict[str, Any], file: Path | str, prefix: str = "") -> None:
        self.data, self.file, self.prefix = data, file, prefix
        self._read: set[str] = set()

    @classmethod
    def load(cls, file: Path) -> "Table":
        """A TOML file's top table; raises ContentError where it cannot be read."""
        try:
            with file.open("rb") as handle:
                data = tomllib.load(handle)
        except OSError as error:
            raise ContentError(file, "file", f"cannot be read ({error.strerror})") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ContentError(file, "TOML", str(error)) from None
        for key, value in unprintable(data):
            raise ContentError(file, key, f"has a control character in it: {value[:80]!r}")
        return cls(data, file)

    def error(self, key: str, problem: str) -> ContentError:
        """An error about one key of this table, to be raised."""
        return ContentError(self.file, self.prefix + key, problem)

    def get(self, key: str, kind: type | tuple[type, ...], default: Any = ...) -> Any:
        """Value of `key`, checked for its type (an int passes as float, a bool passes as neither)."""
        self._read.add(key)
        if key not in self.data:
            if default is ...:
                raise self.error(key, f"is missing, expected {_name(kind)}")
            return default
        value = self.data[key]
        kinds = kind if isinstance(kind, tuple) else (kind,)
        if float in kinds and isinstance(value, int) and not isinstance(value, bool):
            try:
                value = float(value)
            except OverflowError:
                raise self.error(key, "is an integer too large to be a number") from None
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise self.error(key, f"must be {_name(kind)}, got {value!r}")
        return value

    def number(self, key: str, low: float, high: float, default: Any = ...) -> float:
        """A number within [low, high]."""
        value = self.get(key, float, default)
        if not low <= value <= high:
            raise self.error(key, f"must lie in [{low}, {high}], got {value}")
        return float(value)

    def integer(self, key: str, low: int, high: int, default: Any = ...) -> int:
        """An integer within [low, high]."""
        value = self.get(key, int, default)
        if not low <= value <= high:
            raise self.error(key, f"must lie in [{low}, {high}], got {value}")
        return int(value)

    def choice(self, key: str, known: tuple[str, ...], default: Any = ...) -> str:
        """One of the known values."""
        value = self.get(key, str, default)
        self.one_of(key, value, known)
        return str(value)

    def one_of(self, key: str, value: str, known: Sequence[str]) -> None:
        """Refuse a value of `key` that is not among the known ones."""
        if value not in known:
            near = difflib.get_close_matches(value, known, n=1, cutoff=0.5)
            raise self.error(key, f"unknown value {value!r}, " + (f"did you mean {near[0]!r}? " if near else "") + f"known: {', '.join(known)}")

    def strings(self, key: str, default: Any = ...) -> tuple[str, ...]:
        """A list of non-empty strings."""
        value = self.get(key, list, default)
        if not all(isinstance(item, str) and item for item in value):
            raise self.error(key, f"must be a list of non-empty strings, got {value!r}")
        return tuple(value)

    def numbers(self, key: str, length: int) -> tuple[float, ...]:
        """A list of so many numbers."""
        value = self.get(key, list)
        if len(value) != length or not all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            raise self.error(key, f"must be a list of {length} numbers, got {value!r}")
        return tuple(float(item) for item in value)

    def interval(self, key: str, default: Any = ...) -> tuple[float, float]:
        """A pair [low, high]."""
        value = self.get(key, list, default)
        numbers = [item for item in value if isinstance(item, int | float) and not isinstance(item, bool)]
        if len(value) != 2 or len(numbers) != 2 or numbers[0] > numbers[1]:
            raise self.error(key, f"must be [low, high] with low <= high, got {value!r}")
        return float(value[0]), float(value[1])

    def table(self, key: str, default: Any = ...) -> "Table":
        """A table within this one."""
        value = self.get(key, dict, default)
        return Table(value, self.file, f"{self.prefix}{key}.")

    def done(self) -> None:
        """Refuse keys that nobody read."""
        for key in self.data:
            if key not in self._read:
                near = difflib.get_close_matches(key, self._read, n=1, cutoff=0.5)
                raise self.error(
                    key, "is not a known key" + (f", did you mean {near[0]!r}?" if near else f"; known: {', '.join(sorted(self._read))}")
                )


def _name(kind: type | tuple[type, ...]) -> str:
    names = {str: "a string", int: "an integer", float: "a number", bool: "true or false", list: "a list", dict: "a table"}
    return " or ".join(names.get(k, k.__name__) for k in (kind if isinstance(kind, tuple) else (kind,)))
