"""Terms of task files, `name(role, ...)`: predicates of goals and subgoals, and skills of the scripted expert."""

from collections.abc import Mapping
from dataclasses import dataclass

from osel_sim.formats.validate import Table

KINDS = ("object", "container", "zone", "peg", "drawer", "button", "door")
"""Kinds of things. Objects lie loose; all others stand fast, some with a part that moves."""
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
