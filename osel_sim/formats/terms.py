"""Terms of task files, `name(role, ...)`: predicates of goals and subgoals, and skills of the scripted expert."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from osel_sim.formats.toml_types import shown, unknown_value

KINDS = ("object", "container", "zone", "peg", "drawer", "button", "door")
"""Kinds of things. Objects lie loose; all others stand fast, some with a part that moves."""
ATTRIBUTE = "attribute"
"""Kind of a role that names a property (a rule such as "the red things") instead of a thing."""
RECEPTACLES = ("container", "zone", "peg", "drawer")
"""Kinds that objects can be put into, onto or around."""
HINGED = ("drawer", "door")
"""Kinds that open and close."""
ARTICULATED = (*HINGED, "button")
"""Kinds with a part that moves."""

Signature = tuple[tuple[str, ...], ...]
"""Kinds that each argument may be of."""

PREDICATES: Mapping[str, Signature] = {
    "near": (KINDS,),
    "grasped": (KINDS,),
    "lifted": (("object",),),
    "released": (KINDS,),
    "in": (("object",), RECEPTACLES),
    "on": (("object",), ("object",)),
    "opened": (HINGED,),
    "closed": (HINGED,),
    "pressed": (("button",),),
}
"""Known predicates (osel_sim.sim.predicates has their meaning)."""

SKILLS: Mapping[str, Signature] = {
    "reach": (KINDS,),
    "grasp": (KINDS,),
    "lift": (("object",),),
    "move": (("object",), (*RECEPTACLES, "object")),
    "place": (("object",), (*RECEPTACLES, "object")),
    "push": (("object",), ("zone",)),
    "open": (HINGED,),
    "close": (HINGED,),
    "press": (("button",),),
}
"""Known skills of the scripted expert (osel_sim.sim.expert)."""


@dataclass(frozen=True)
class Term:
    """`name(role, ...)` of a goal, subgoal or plan."""

    name: str
    roles: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.name}({', '.join(self.roles)})"

    def faults(self, known: Mapping[str, Signature], roles: Mapping[str, str]) -> Iterator[str]:
        """What makes no sense about it: roles that there are not, or things of the wrong kind.

        Args:
            known: `PREDICATES` or `SKILLS`.
            roles: role -> kind of thing that fills it.
        """
        for role, kinds in zip(self.roles, known[self.name], strict=True):
            if role not in roles:
                yield f"{shown(str(self))}: {unknown_value(role, roles)}"
            elif roles[role] not in kinds:
                yield f"{shown(str(self))}: {role!r} is of kind {roles[role]!r}, {self.name} wants one of {', '.join(kinds)}"


@dataclass(frozen=True)
class TermOf:
    """Annotates a `Term` that a TOML file gives as text, of `known` predicates or skills."""

    known: Mapping[str, Signature]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._parse, core_schema.str_schema())

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), "pattern": rf"^\s*({'|'.join(self.known)})\s*\([^()]*\)\s*$"}

    def _parse(self, text: str) -> Term:
        name, bracket, rest = (part.strip() for part in text.partition("("))
        if not bracket or not rest.endswith(")"):
            raise ValueError(f"{shown(text)} must read name(role, ...)")
        if name not in self.known:
            raise ValueError(f"{shown(text)}: {unknown_value(name, self.known)}")
        roles = tuple(part.strip() for part in rest[:-1].split(","))
        if len(roles) != len(self.known[name]):
            raise ValueError(f"{shown(text)}: {name} takes {len(self.known[name])} role(s), got {len(roles)}")
        return Term(name, roles)
