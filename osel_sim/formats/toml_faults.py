"""What pydantic found wrong with a TOML file, in plain words: the key, and what would be right."""

import copy
from collections.abc import Iterable
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from osel_sim.core.errors import nearest
from osel_sim.formats.schema_node import Node, Place
from osel_sim.formats.toml_types import plain_name, quoted, unknown_value

_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")
_BOUNDS = ("greater_than_equal", "less_than_equal", "finite_number")
_LIKENESS = 0.6
"""How like a misspelt key is to the one that it is taken for. Half is too little: `name` would be `zone`."""
_KEY_OF_TABLE = "[key]"
"""What pydantic puts at the end of the place of a table's key that is not one of those allowed."""


def faults_of(error: ValidationError, schema: Node) -> list[tuple[str, str]]:
    """All faults as (key, problem), but for keys that are not allowed.

    Args:
        schema: the model's, from which the words are taken, so that what a value must be is said once: by the model's types.
    """
    found: dict[tuple[str, str], None] = {}  # a set in order: a list that lacks two numbers is one fault
    for detail in error.errors(include_url=False):
        # A list is also told to be empty where all its items are wrong.
        if _unknown_key(detail) is None and not (detail["type"] == "too_short" and detail["input"]):
            found[_fault(schema, detail)] = None
    return list(found)


def spelt_right(error: ValidationError, schema: Node, data: dict[str, Any]) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Keys that are not allowed as (key, problem), and the data with what was probably meant in their place.

    What is wrong besides is then found as if they were spelt right, so that nothing is told to be missing because its name is.

    Args:
        schema: the model's.
        data: what was validated.
    """
    found, data = [], copy.deepcopy(data)
    for detail in error.errors(include_url=False):
        place, node, key, near = _misspelt(schema, detail)
        if key is None:
            continue
        table = _at(data, place)
        if table is None:  # it lay in a table whose key is corrected now: the next look finds it there
            continue
        known = [other for other in node.keys if other != key]
        near = near or _nearest(key, [other for other in known if other not in table]) or _nearest(key, known)
        hint = f", did you mean {near!r}?" if near else f"; known: {', '.join(sorted(known))}"
        found.append((_called((*place, key)), f"is not a known key{hint}"))
        value = table.pop(key)
        if near is not None:
            table.setdefault(near, value)
    return found, data


def _misspelt(schema: Node, detail: ErrorDetails) -> tuple[Place, Node, str | None, str | None]:
    """Table with a key that is not allowed, what the schema says of the table, that key, and the right one where it is known."""
    if (unknown := _unknown_key(detail)) is not None:
        return *schema.walk(unknown[:-1]), str(unknown[-1]), None
    (place, node), table = schema.walk(detail["loc"]), detail["input"]
    if detail["type"] != "union_tag_not_found" or node.tag is None or not isinstance(table, dict):
        return place, node, None, None
    tag, _ = node.tag  # without it, pydantic does not know which keys to look for
    return place, node, _nearest(tag, set(table) - set(node.keys)), tag


def _nearest(key: str, known: Iterable[str]) -> str | None:
    return next(iter(nearest(key, known, cutoff=_LIKENESS)), None)


def _unknown_key(detail: ErrorDetails) -> Place | None:
    """The place of a key that is not allowed; None where it is allowed."""
    place = detail["loc"]
    if detail["type"] in _UNKNOWN_KEY:
        return place
    return place[:-1] if len(place) > 1 and place[-1] == _KEY_OF_TABLE and place[-2] == detail["input"] else None


def _at(data: dict[str, Any], place: Place) -> Any:
    """The table at a place, or None where there is none."""
    table: Any = data
    for step in place:
        if isinstance(step, str) and step not in table:
            return None
        table = table[step]
    return table


def _fault(schema: Node, detail: ErrorDetails) -> tuple[str, str]:
    """(key, problem) of a fault at a key that is allowed."""
    kind, value = detail["type"], detail["input"]
    place, node = schema.walk(detail["loc"])
    if kind == "fault":
        return _called(place), detail["msg"]
    if kind == "wanted":
        return _called(place), f"must be {detail['msg']}, got {quoted(value)}"
    if kind == "value_error":
        return _called(place), str(detail["ctx"]["error"])
    if kind == "missing" and isinstance(place[-1], str):
        return _called(place), f"is missing, expected {node.wanted}"
    if kind == "missing":  # the second number of a pair: what is wrong is the list
        place, node = schema.walk(detail["loc"][:-1])
    if kind.startswith("union_tag") and node.tag is not None and isinstance(value, dict):
        return _tag(place, node.tag[0], list(node.tag[1]), value)
    if node.choices and isinstance(value, str):
        while isinstance(place[-1], int):  # the value itself says which item of the list is meant
            place = place[:-1]
        return _called(place), unknown_value(value, node.choices)
    return _called(place), _wrong(node, kind, value)


def _tag(place: Place, key: str, known: list[str], table: dict[str, Any]) -> tuple[str, str]:
    """(key, problem) of a table whose form is told by one of its keys, where that is missing or unknown."""
    if key not in table:
        return _called((*place, key)), f"is missing, expected one of {', '.join(known)}"
    given = table[key]
    problem = unknown_value(given, known) if isinstance(given, str) else f"must be one of {', '.join(known)}, got {quoted(given)}"
    return _called((*place, key)), problem


def _wrong(node: Node, kind: str, value: object) -> str:
    """What is wrong with a value that has the wrong type, size or length."""
    bounded = next((option.own for option in node.options() if "minimum" in option.own), None)
    if kind in _BOUNDS and bounded is not None:
        number = float(value) if bounded["type"] == "number" else value  # type: ignore[arg-type]  # it was found to be a number
        bounds = f"lie in [{bounded['minimum']}, {bounded['maximum']}]" if "maximum" in bounded else f"be {bounded['minimum']} or more"
        return f"must {bounds}, got {quoted(number)}"
    if kind == "finite_number":
        return f"must be a finite number, got {quoted(value)}"
    if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
        return "is an integer too large to be a number"
    if kind in ("string_too_short", "too_short") and not value:
        return "must not be empty"
    return f"must be {node.wanted}, got {quoted(value)}"


def _called(place: Place) -> str:
    """`scene.region.object.x`, `language.train[3]`."""
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else ("." if text else "") + plain_name(step)
    return text
