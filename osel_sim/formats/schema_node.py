"""A JSON Schema as error messages want it: what a value at some place must be, in words."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value."""

_TYPES = {"string": "a string", "integer": "an integer", "number": "a number", "boolean": "true or false", "array": "a list", "object": "a table"}


@dataclass(frozen=True)
class Node:
    """What a schema says of a value.

    Attributes:
        root: the whole schema.
        own: the part about this value.
    """

    root: dict[str, Any]
    own: dict[str, Any]

    def options(self) -> Iterator["Node"]:
        """What the value may be, where there is a choice; TOML has no null."""
        own = self.own
        while "$ref" in own:
            own = self.root["$defs"][own["$ref"].rpartition("/")[2]]
        branches = own.get("anyOf", own.get("oneOf"))
        if branches is None:
            yield Node(self.root, own)
        else:
            for branch in branches:
                if branch.get("type") != "null":
                    yield from Node(self.root, branch).options()

    @property
    def tag(self) -> tuple[str, dict[str, str]] | None:
        """The key that tells a table's form, and the forms by its values."""
        found = self.own.get("discriminator")
        return None if found is None else (found["propertyName"], found["mapping"])

    @property
    def keys(self) -> list[str]:
        """Keys that a table may have."""
        tables = [option.own for option in self.options()]
        return [key for table in tables for key in table.get("properties", table.get("propertyNames", {}).get("enum", ()))]

    @property
    def choices(self) -> list[str]:
        """The values there are, where they are counted."""
        options = [option.own for option in self.options()]
        if len(options) != 1:
            return []
        return [str(value) for value in options[0].get("enum", [options[0]["const"]] if "const" in options[0] else [])]

    @property
    def wanted(self) -> str:
        """What the value must be: `an integer`, `a list of 2 numbers`, `one of local, remote`."""
        words = []
        for option in self.options():
            if choices := option.choices:
                words.append(f"one of {', '.join(choices)}" if len(choices) > 1 else repr(choices[0]))
            elif "prefixItems" in option.own:
                items = option.own["prefixItems"]
                words.append(f"a list of {len(items)} {Node(self.root, items[0]).wanted.partition(' ')[2]}s")
            else:
                words.append(_TYPES.get(option.own.get("type", ""), "another value"))
        return " or ".join(dict.fromkeys(words))

    def walk(self, place: Place) -> tuple[Place, "Node"]:
        """Follow a place as pydantic gives it, with the names of unions' branches between the keys.

        Returns:
            The place without these names, and what the schema says of the value there.
        """
        node, keys = self, []
        for step in place:
            child = next((child for option in node.options() if (child := option._child(step)) is not None), None)
            if child is not None:
                node = child
                keys.append(step)
            elif node.tag is not None and step in node.tag[1]:
                node = Node(self.root, {"$ref": node.tag[1][str(step)]})
        return tuple(keys), node

    def _child(self, step: str | int) -> "Node | None":
        if isinstance(step, int):
            items = self.own.get("prefixItems", ())
            found = items[step] if step < len(items) else self.own.get("items")
        else:
            found = self.own.get("properties", {}).get(step, self.own.get("additionalProperties"))
        return Node(self.root, found) if isinstance(found, dict) else None
