"""Terms of task files, `name(role, ...)`: predicates of goals and subgoals, and skills of the scripted expert."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from osel_sim.core.registry import Registry
from osel_sim.formats.validate import Table
from osel_sim.interface.terms import Predicate, Signature, Skill

KINDS = ("object", "container", "zone", "peg", "drawer", "button", "door")
"""Kinds of things. Objects lie loose; all others stand fast, some with a part that moves."""
RECEPTACLES = ("container", "zone", "peg", "drawer")
"""Kinds that objects can be put into, onto or around."""
HINGED = ("drawer", "door")
"""Kinds that open and close."""
ARTICULATED = (*HINGED, "button")
"""Kinds with a part that moves."""


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


def parse_term(table: Table, key: str, text: str, known: Mapping[str, Signature], roles: Mapping[str, str]) -> Term:
    """Read one term.

    Args:
        table, key: where it stands, for complaints.
        known: `PREDICATES` or `SKILLS`.
        roles: role -> kind of thing that fills it.

    Raises:
        ContentError: not of that form, an unknown name or role, or a thing of a kind that makes no sense there.
    """
    name, bracket, rest = (part.strip() for part in text.partition("("))
    if not bracket or not rest.endswith(")"):
        raise table.error(key, f"{text!r} must read name(role, ...)")
    table.one_of(key, name, list(known))
    arguments = tuple(part.strip() for part in rest[:-1].split(","))
    if len(arguments) != len(known[name]):
        raise table.error(key, f"{text!r}: {name} takes {len(known[name])} role(s), got {len(arguments)}")
    for role, kinds in zip(arguments, known[name], strict=True):
        table.one_of(key, role, list(roles))
        if roles[role] not in kinds:
            raise table.error(key, f"{text!r}: {role!r} is of kind {roles[role]!r}, {name} wants one of {', '.join(kinds)}")
    return Term(name, arguments)
