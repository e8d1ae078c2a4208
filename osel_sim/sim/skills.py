"""The skills that plans of task files can name; how each is done says `osel_sim.sim.expert`. Light, since it is read with every task file."""

from typing import TYPE_CHECKING

from osel_sim.formats.terms import HINGED, KINDS, RECEPTACLES
from osel_sim.interface.terms import Skill
from osel_sim.sim import predicates

if TYPE_CHECKING:
    from osel_sim.sim.expert import Expert


def _opened(expert: "Expert", thing: str) -> bool:
    return predicates.opened(expert.world, thing)


def _closed(expert: "Expert", thing: str) -> bool:
    return predicates.closed(expert.world, thing)


def _pressed(expert: "Expert", thing: str) -> bool:
    return predicates.pressed(expert.world, thing)


def _put(expert: "Expert", thing: str, place: str) -> bool:
    return expert.has_put(thing, place)


_OBJECT = ("object",)
_PLACE = (*RECEPTACLES, "object")

reach = Skill((KINDS,), lambda expert, thing: expert.reach(thing))
grasp = Skill((KINDS,), lambda expert, thing: expert.grasp(thing))
lift = Skill((_OBJECT,), lambda expert, thing: expert.lift(thing))
move = Skill((_OBJECT, _PLACE), lambda expert, thing, place: expert.move(thing, place))
place = Skill((_OBJECT, _PLACE), lambda expert, thing, place: expert.place(thing, place), achieved=_put)
push = Skill((_OBJECT, ("zone",)), lambda expert, thing, zone: expert.push(thing, zone), achieved=_put)
open = Skill((HINGED,), lambda expert, thing: expert.open(thing), achieved=_opened)
close = Skill((HINGED,), lambda expert, thing: expert.close(thing), achieved=_closed)
press = Skill((("button",),), lambda expert, button: expert.press(button), achieved=_pressed)
