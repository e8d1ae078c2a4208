"""Predicates of goals and subgoals, over the world as it is now. Task files name them; `formats.terms.PREDICATES` lists them."""

import math
from typing import TYPE_CHECKING

from osel_sim.formats.terms import HINGED, KINDS, RECEPTACLES, Term, predicates
from osel_sim.interface.terms import predicate

if TYPE_CHECKING:
    from osel_sim.sim.world import World

NEAR = 0.05
"""`near`: distance of the grip site to the object's grasp point, metres."""
LIFTED = 0.04
"""`lifted`: height above where the object started, metres."""

RESTING = 0.006
"""`on`: gap between the thing's lowest and the base's highest point, metres."""
OPENED, CLOSED, PRESSED = 0.7, 0.08, 0.6
"""Shares of the travel; robosuite's door counts as open at 0.3 of 0.4 rad."""


def holds(world: "World", term: Term) -> bool:
    """Whether a predicate of the task holds now; roles are those of the loaded instance."""
    return predicates.load(term.name)(world, *(world.instance.roles[role] for role in term.roles))


@predicate(KINDS)
def near(world: "World", thing: str) -> bool:
    """The grip site is at the thing's grasp point."""
    return math.dist(world.grip_position, world.grasp_point(thing)) < NEAR


@predicate(KINDS)
def grasped(world: "World", thing: str) -> bool:
    """Both fingers touch the thing."""
    return all(world.touches(finger, thing) for finger in ("left", "right"))


@predicate(KINDS)
def released(world: "World", thing: str) -> bool:
    """No finger touches the thing."""
    return not any(world.touches(finger, thing) for finger in ("left", "right"))


@predicate(("object",))
def lifted(world: "World", thing: str) -> bool:
    """The thing is well above where it started."""
    return bool(world.position(thing)[2] - world.start_height(thing) > LIFTED)


@predicate(("object",), RECEPTACLES)
def inside(world: "World", thing: str, receptacle: str) -> bool:
    """The thing's middle is within the receptacle, and its lowest point is below the rim (or on the plate, in the zone, down the peg)."""
    place = world.place_point(receptacle)
    offset = world.position(thing) - place
    entity = world.task.entity(receptacle)
    return bool(math.hypot(offset[0], offset[1]) < entity.inner and world.lowest_point(thing) < place[2] + entity.rim)


@predicate(("object",), ("object",))
def on(world: "World", thing: str, base: str) -> bool:
    """The thing rests on the other: they touch, it is above, and not beside."""
    offset = world.position(thing) - world.position(base)
    above = abs(world.lowest_point(thing) - world.highest_point(base)) < RESTING
    return bool(above and math.hypot(offset[0], offset[1]) < world.task.entity(base).radius and world.in_contact(thing, base))


@predicate(HINGED)
def opened(world: "World", thing: str) -> bool:
    """The drawer or door is (nearly) as far open as it goes."""
    return world.opening(thing) > OPENED


@predicate(HINGED)
def closed(world: "World", thing: str) -> bool:
    """The drawer or door is shut."""
    return world.opening(thing) < CLOSED


@predicate(("button",))
def pressed(world: "World", thing: str) -> bool:
    """The button is down."""
    return world.opening(thing) > PRESSED
