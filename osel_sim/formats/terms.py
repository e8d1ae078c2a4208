"""Terms of task files, `name(role, ...)`: predicates of goals and subgoals, and skills of the scripted expert."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from osel_sim.core.registry import Registry
from osel_sim.formats.toml_types import quoted, unknown_value
from osel_sim.interface.terms import Predicate, Signature, Skill

KINDS = ("object", "container", "zone", "peg", "drawer", "button", "door")
"""Kinds of things. Objects lie loose; all others stand fast, some with a part that moves."""
ATTRIBUTE = "attribute"
"""Kind of a role that names a property (a rule such as "the red things") instead of a thing."""
RECEPTACLES = ("container", "zone", "peg", "drawer")
"""Kinds that objects can be put into, onto or around."""
HINGED = ("drawer", "door")
"""Kinds that open and close."""


class Signatures(Mapping[str, Signature]):
    """Name -> kinds of arguments, of predicates or skills; imported when they are asked for."""

    def __init__(self, registry: Registry[Predicate] | Registry[Skill]) -> None:
        self._registry = registry

    def __getitem__(self, name: str) -> Signature:
        if name not in self._registry:
            raise KeyError(name)
        return self._registry.load(name).kinds

    def __iter__(self) -> Iterator[str]:
        return iter(self._registry)

    def __len__(self) -> int:
        return sum(1 for _ in self._registry)


_PREDICATES = ("near", "grasped", "released", "lifted", "on", "opened", "closed", "pressed")
_SKILLS = ("reach", "grasp", "lift", "move", "place", "push", "open", "close", "press")

predicates = Registry(
    "predicate",
    "osel_sim.predicates",
    {"in": "osel_sim.sim.predicates:inside"} | {name: f"osel_sim.sim.predicates:{name}" for name in _PREDICATES},
    Predicate,
)
skills = Registry("skill", "osel_sim.skills", {name: f"osel_sim.sim.skills:{name}" for name in _SKILLS}, Skill)
PREDICATES: Mapping[str, Signature] = Signatures(predicates)
SKILLS: Mapping[str, Signature] = Signatures(skills)


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
                yield f"{quoted(str(self))}: {unknown_value(role, roles)}"
            elif roles[role] not in kinds:
                yield f"{quoted(str(self))}: {role!r} is of kind {roles[role]!r}, {self.name} wants one of {', '.join(kinds)}"


@dataclass(frozen=True)
class TermOf:
    """Annotates a `Term` that a TOML file gives as text, of `known` predicates or skills."""

    known: Mapping[str, Signature]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._parse, core_schema.str_schema())

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), "pattern": r"^\s*\w+\s*\([^()]*\)\s*$"}  # which names there are, packages may add to

    def _parse(self, text: str) -> Term:
        name, bracket, rest = (part.strip() for part in text.partition("("))
        if not bracket or not rest.endswith(")"):
            raise ValueError(f"{quoted(text)} must read name(role, ...)")
        if name not in self.known:
            raise ValueError(f"{quoted(text)}: {unknown_value(name, self.known)}")
        roles = tuple(part.strip() for part in rest[:-1].split(","))
        if len(roles) != len(self.known[name]):
            raise ValueError(f"{quoted(text)}: {name} takes {len(self.known[name])} role(s), got {len(roles)}")
        return Term(name, roles)
