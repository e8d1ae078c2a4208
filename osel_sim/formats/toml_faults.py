"""What pydantic found wrong with a TOML file, in plain words: the key, and what would be right."""

import difflib
from collections.abc import Iterator, Set
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from osel_sim.formats.toml_types import LONGEST, shown, unknown_value

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value; as pydantic gives it, with the names of a union's branches between them."""
Node = dict[str, Any]
"""A node of a JSON Schema. The words come from it, so that what a value must be is said once, by the model's types."""

_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")
_BOUNDS = ("greater_than_equal", "less_than_equal", "finite_number")
_TYPES = {"string": "a string", "integer": "an integer", "number": "a number", "boolean": "true or false", "array": "a list", "object": "a table"}
_KEY_OF_TABLE = "[key]"
"""What pydantic puts at the end of the place of a table's key that is not one of those allowed."""


def faults_of(error: ValidationError, schema: Node, data: Node) -> list[tuple[str, str]]:
    """All faults as (key, problem). A missing key and a misspelt one in its place are one fault.

    Args:
        schema: JSON Schema of the model.
        data: what was validated.
    """
    details = error.errors(include_url=False)
    missing = {detail["loc"] for detail in details if detail["type"] == "missing"}
    unknown: dict[Place, str] = {}
    for place in filter(None, map(_unknown_key, details)):
        unknown[place], meant = _unknown(schema, data, place, {str(other[-1]) for other in missing if other[:-1] == place[:-1]})
        missing.discard((*place[:-1], meant or ""))
    found: dict[tuple[str, str], None] = {}  # a set in order: a list that lacks two numbers is one fault
    for detail in details:
        key = _unknown_key(detail)
        if key is not None:
            table, _ = _walk(schema, key[:-1])
            found[_called((*table, key[-1])), unknown[key]] = None
        elif detail["type"] != "missing" or detail["loc"] in missing:
            found[_known(schema, detail)] = None
    return list(found)


def _unknown_key(detail: ErrorDetails) -> Place | None:
    """The place of a key that is not allowed; None where it is allowed."""
    place = detail["loc"]
    if detail["type"] in _UNKNOWN_KEY:
        return place
    return place[:-1] if place and place[-1] == _KEY_OF_TABLE else None


def _unknown(schema: Node, data: Node, place: Place, missing: Set[str]) -> tuple[str, str | None]:
    """What is wrong with a key that is not allowed, and the key that was probably meant."""
    table, node = _walk(schema, place[:-1])
    value: Any = data
    for step in table:
        value = value[step]
    known = [key for option in _options(schema, node) for key in option.get("properties", option.get("propertyNames", {}).get("enum", ()))]
    for candidates in (missing, set(known) - set(value), known):
        near = difflib.get_close_matches(str(place[-1]), sorted(candidates), n=1, cutoff=0.5)
        if near:
            return f"is not a known key, did you mean {near[0]!r}?", near[0]
    return f"is not a known key; known: {', '.join(sorted(known))}", None


def _known(schema: Node, detail: ErrorDetails) -> tuple[str, str]:
    """(key, problem) of a fault at a key that is allowed."""
    kind, value = detail["type"], detail["input"]
    place, node = _walk(schema, detail["loc"])
    if kind == "fault":
        return _called(place), detail["msg"]
    if kind == "wanted":
        return _called(place), f"must be {detail['msg']}, got {shown(value)}"
    if kind == "value_error":
        return _called(place), str(detail["ctx"]["error"])
    if kind == "missing" and isinstance(place[-1], str):
        return _called(place), f"is missing, expected {_wanted(schema, node)}"
    if kind == "missing":  # the second number of a pair: what is wrong is the list
        place, node = _walk(schema, detail["loc"][:-1])
    if kind.startswith("union_tag"):
        return _tag(schema, place, node, value)
    choices = _choices(schema, node)
    if choices and isinstance(value, str):
        while isinstance(place[-1], int):  # the value itself says which item of the list is meant
            place = place[:-1]
        return _called(place), unknown_value(value, choices)
    return _called(place), _wrong(schema, node, kind, value)


def _wrong(schema: Node, node: Node, kind: str, value: object) -> str:
    """What is wrong with a value that has the wrong type, size or length."""
    bounded = next((option for option in _options(schema, node) if "minimum" in option), None)
    if kind in _BOUNDS and bounded is not None:
        number = float(value) if bounded["type"] == "number" else value  # type: ignore[arg-type]  # it was found to be a number
        bounds = f"lie in [{bounded['minimum']}, {bounded['maximum']}]" if "maximum" in bounded else f"be {bounded['minimum']} or more"
        return f"must {bounds}, got {shown(number)}"
    if kind == "finite_number":
        return f"must be a finite number, got {shown(value)}"
    if kind == "float_type" and isinstance(value, int) and not isinstance(value, bool):
        return "is an integer too large to be a number"
    if kind in ("string_too_short", "too_short") and not value:
        return "must not be empty"
    return f"must be {_wanted(schema, node)}, got {shown(value)}"


def _tag(schema: Node, place: Place, node: Node, value: object) -> tuple[str, str]:
    """(key, problem) of a table whose form is told by one of its keys, where that is missing or unknown; or of a value of no known form."""
    if "discriminator" not in node or not isinstance(value, dict):
        return _called(place), f"must be {_wanted(schema, node)}, got {shown(value)}"
    key, known = str(node["discriminator"]["propertyName"]), list(node["discriminator"]["mapping"])
    if key not in value:
        return _called((*place, key)), f"is missing, expected one of {', '.join(known)}"
    given = value[key]
    return _called((*place, key)), unknown_value(given, known) if isinstance(given, str) else f"must be one of {', '.join(known)}, got {shown(given)}"


def _wanted(schema: Node, node: Node) -> str:
    """What a value must be: `an integer`, `a list of 2 numbers`, `one of local, remote`."""
    wanted = []
    for option in _options(schema, node):
        if choices := _choices(schema, option):
            wanted.append(f"one of {', '.join(choices)}" if len(choices) > 1 else repr(choices[0]))
        elif "prefixItems" in option:
            item = _wanted(schema, _resolved(schema, option["prefixItems"][0])).partition(" ")[2]
            wanted.append(f"a list of {len(option['prefixItems'])} {item}s")
        else:
            wanted.append(_TYPES.get(option.get("type", ""), "another value"))
    return " or ".join(dict.fromkeys(wanted))


def _choices(schema: Node, node: Node) -> list[str]:
    options = list(_options(schema, node))
    if len(options) != 1:
        return []
    return list(map(str, options[0].get("enum", [options[0]["const"]] if "const" in options[0] else [])))


def _walk(schema: Node, place: Place) -> tuple[Place, Node]:
    """A place without the branches of unions, and what the schema says of it."""
    node, keys = _resolved(schema, schema), []
    for step in place:
        child = next((child for option in _options(schema, node) if (child := _child(option, step)) is not None), None)
        if child is not None:
            node = _resolved(schema, child)
            keys.append(step)
        elif step in (branches := node.get("discriminator", {}).get("mapping", {})):
            node = _resolved(schema, {"$ref": branches[step]})
    return tuple(keys), node


def _child(node: Node, step: str | int) -> Node | None:
    if isinstance(step, int):
        items = node.get("prefixItems", ())
        found = items[step] if step < len(items) else node.get("items")
    else:
        found = node.get("properties", {}).get(step, node.get("additionalProperties"))
    return found if isinstance(found, dict) else None


def _options(schema: Node, node: Node) -> Iterator[Node]:
    """What a value may be, where there is a choice; TOML has no null."""
    node = _resolved(schema, node)
    options = node.get("anyOf", node.get("oneOf"))
    if options is None:
        yield node
    else:
        for option in options:
            if option.get("type") != "null":
                yield from _options(schema, option)


def _resolved(schema: Node, node: Node) -> Node:
    while "$ref" in node:
        node = schema["$defs"][node["$ref"].rpartition("/")[2]]
    return node


def _called(place: Place) -> str:
    """`scene.region.object.x`; keys that cannot be printed as they are, are quoted."""
    text = ""
    for step in place:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            plain = step and step.isprintable() and len(step) <= LONGEST
            text += ("." if text else "") + (step if plain else shown(step))
    return text
