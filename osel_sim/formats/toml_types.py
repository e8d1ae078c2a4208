"""What pydantic models of TOML files share: their configuration and the types of their values."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import AfterValidator, ConfigDict, Field, GetCoreSchemaHandler, StringConstraints, ValidationError, ValidationInfo
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from osel_sim.core.errors import did_you_mean

TABLE = ConfigDict(extra="forbid", allow_inf_nan=False, defer_build=True)
"""Configuration of every model: unknown keys are refused, numbers are finite.

Validators see the fields above theirs (`info.data`): defaults are `dataclasses.field`s, as pydantic would put its own `Field`s before all others."""

Faults = Iterator[tuple[tuple[str | int, ...], str]]
"""What a validator found wrong: (place within the value, problem) of each fault."""
LONGEST = 80
"""Values are shown up to so many characters."""


@dataclass(frozen=True)
class OneOf:
    """Annotates a string that must be one of `known`."""

    known: Iterable[str]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.known))


def between(low: float, high: float) -> Any:
    """Annotates a number within [low, high]. Strings and true are no numbers; an integer will do where a float is wanted."""
    return Field(strict=True, ge=low, le=high)


def at_least(low: int) -> Any:
    """Annotates an integer of `low` or more."""
    return Field(strict=True, ge=low)


def quoted(value: object) -> str:
    """A value as error messages show it: control characters escaped, at most `LONGEST` characters of it."""
    try:
        text = repr(value)
    except ValueError:  # Python does not print integers of more than 4300 digits
        text = "a number of thousands of digits"
    return text if len(text) <= LONGEST else text[:LONGEST] + "..."


def plain_name(name: str) -> str:
    """A name as error messages show it: as it is, or quoted where it is empty, long or has control characters."""
    return name if name and name.isprintable() and len(name) <= LONGEST else quoted(name)


def unknown_value(value: str, known: Iterable[str]) -> str:
    """What is wrong with a value that is not among those known."""
    known = list(known)
    return f"unknown value {quoted(value)}, {did_you_mean(value, known)}known: {', '.join(map(plain_name, known))}"


def refuse(*faults: tuple[tuple[str | int, ...], str]) -> NoReturn:
    """Raise what a validator found wrong within its value: (place within it, problem) of each fault."""
    lines = [
        InitErrorDetails(type=PydanticCustomError("fault", "{problem}", {"problem": problem}), loc=place, input=None) for place, problem in faults
    ]
    raise ValidationError.from_exception_data("faults", lines)


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError(f"must be [low, high] with low <= high, got {quoted(list(pair))}")
    return pair


def _is_the_files(name: str, info: ValidationInfo) -> str:
    if info.context is not None and name != (stem := Path(info.context["file"]).stem):
        raise ValueError(f"must equal the file's name {stem!r}, got {quoted(name)}")
    return name


Version = Annotated[int, between(1, 1)]
Number = Annotated[float, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
ordered = AfterValidator(_ordered)
"""Annotates a pair [low, high]."""
Interval = Annotated[tuple[Number, Number], ordered]
Text = Annotated[str, StringConstraints(min_length=1)]
Texts = tuple[Text, ...]
FileName = Annotated[str, AfterValidator(_is_the_files)]
"""The name that a file gives itself: the file's own without `.toml`."""
