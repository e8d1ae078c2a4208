"""The scripted expert on a few instances of a task, and why it fails where it does (`python -m osel_sim.doctor --task FILE`)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from osel_sim.core.errors import UsageError
from osel_sim.formats.task_file import TaskSpec
from osel_sim.formats.terms import Term
from osel_sim.sim import predicates
from osel_sim.sim.expert import Expert
from osel_sim.sim.gl import choose_backend
from osel_sim.sim.instance import Instance, make_instance
from osel_sim.sim.scene import TABLE_HEIGHT
from osel_sim.sim.world import World

PATIENCE = 2
"""The expert is watched for so many horizons: a horizon that is too short is told apart from a plan that does not work."""
FALLEN = 0.1
"""So far below the table's top a thing's origin is when it has fallen off, metres."""
INTO = ("move", "place")
"""Skills that put their first thing into their second."""


@dataclass
class Attempt:
    """The expert on one instance.

    Attributes:
        instance, instruction: what was tried.
        steps: control steps until the goal held, at most `PATIENCE` horizons; None: it never did.
        success: it held within the horizon.
        reasons: why not, in words, the likeliest first.
    """

    instance: str
    instruction: str = ""
    steps: int | None = None
    success: bool = False
    reasons: list[str] = field(default_factory=list)


@dataclass
class _Watch:
    """What was seen of an attempt.

    Attributes:
        stages: plan's stage -> steps spent in it.
        nearest: thing -> least distance of the gripper to where it is grasped, metres.
        shut: hinged things that were shut while something was to go into them -> the term.
    """

    stages: dict[int, int] = field(default_factory=dict)
    nearest: dict[str, float] = field(default_factory=dict)
    shut: dict[str, Term] = field(default_factory=dict)


def check_task(task: TaskSpec, seeds: range, level: int = 0) -> list[Attempt]:
    """Let the expert do instances of the test split.

    Raises:
        OselError: the scene cannot be built, or there is no such level.
    """
    choose_backend()  # before robosuite is imported: it forces EGL otherwise
    world = World(task)
    return [_attempt(world, seed, level) for seed in seeds]


def _attempt(world: World, seed: int, level: int) -> Attempt:
    try:
        instance = make_instance(world.task, seed, level)
    except UsageError as error:  # no room, or no property that tells things apart
        return Attempt(f"seed {seed}", reasons=[str(error)])
    attempt, watch = Attempt(instance.key, instance.instruction), _Watch()
    world.load(instance)
    if _unmet(world) == []:
        attempt.reasons.append("the goal holds at the start, before anything is done")
        return attempt
    expert, horizon = Expert(world), world.task.horizon
    for step in range(1, PATIENCE * horizon + 1):
        try:
            world.step(expert.act())
        except Exception as error:  # a skill of somebody else's may raise anything
            attempt.reasons.append(f"{_term(world, expert)} raised {type(error).__name__}: {error}")
            return attempt
        _look(world, expert, watch)
        if _unmet(world) == []:
            attempt.steps, attempt.success = step, step <= horizon
        if attempt.steps is not None or (expert.finished and step >= horizon):
            break
    if not attempt.success:
        attempt.reasons += _reasons(world, expert, attempt, watch)
    return attempt


def _unmet(world: World) -> list[Term]:
    """Terms of the goal that do not hold now."""
    return [term for term in world.task.goal if not predicates.holds(world, term)]


def _term(world: World, expert: Expert) -> Term:
    plan = world.task.plan
    return plan[min(expert.stage, len(plan) - 1)]


def _look(world: World, expert: Expert, watch: _Watch) -> None:
    term, roles = _term(world, expert), world.instance.roles
    watch.stages[expert.stage] = watch.stages.get(expert.stage, 0) + 1
    thing = roles[term.roles[0]]
    watch.nearest[thing] = min(watch.nearest.get(thing, math.inf), math.dist(world.grip_position, world.grasp_point(thing)))
    if term.name in INTO and len(term.roles) > 1:
        place = roles[term.roles[1]]
        if world.task.entity(place).kind == "drawer" and not predicates.opened(world, place):
            watch.shut.setdefault(place, term)


def _reasons(world: World, expert: Expert, attempt: Attempt, watch: _Watch) -> Iterator[str]:
    """Why an attempt failed, as far as can be seen."""
    task, instance = world.task, world.instance
    if attempt.steps is not None:
        yield f"done after {attempt.steps} steps: horizon = {task.horizon} is too short"
        return
    for place, term in watch.shut.items():
        yield (
            f"{place} is {world.opening(place):.0%} open when {term} puts something into it: "
            "let the plan open it first, or let it start open by [scene.start] drawer = [0.9, 1.0]"
        )
    for name in _concerned(task, instance):
        if float(world.position(name)[2]) < TABLE_HEIGHT - FALLEN:
            yield f"{name} fell off the table"
        if watch.nearest.get(name, 0.0) > predicates.NEAR:
            at = next(one for one in instance.placements if one.entity == name)
            yield f"the gripper came no nearer to {name} than {100 * watch.nearest[name]:.0f} cm: is x = {at.x:.2f}, y = {at.y:.2f} out of its reach?"
    longest = max(watch.stages, key=lambda stage: watch.stages[stage])
    if expert.finished:
        yield f"the plan was done to its end, and {_listed(_unmet(world))} did not hold: it lacks a step, or the goal cannot hold as a whole"
    else:
        plan = task.plan
        stuck = plan[min(longest, len(plan) - 1)]
        share = watch.stages[longest] / sum(watch.stages.values())
        yield f"it spent {share:.0%} of the time in {stuck}, step {longest + 1} of {len(plan)} of the plan"
        yield f"at the end {_listed(_unmet(world))} did not hold"


def _concerned(task: TaskSpec, instance: Instance) -> list[str]:
    """Things that the goal and the plan are about."""
    roles = dict.fromkeys(role for term in (*task.plan, *task.goal) for role in term.roles)
    return list(dict.fromkeys(instance.roles[role] for role in roles))


def _listed(terms: list[Term]) -> str:
    return " and ".join(map(str, terms))
