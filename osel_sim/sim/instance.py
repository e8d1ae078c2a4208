"""An instance: one scene with one instruction, fixed bit for bit by (task, seed, level, axes, split) and by the robot that does it."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from osel_sim.core.errors import UsageError
from osel_sim.formats.catalogue import Entity
from osel_sim.formats.levels import instance_key, label, resolve, split_off
from osel_sim.formats.task_file import TaskSpec
from osel_sim.formats.terms import ATTRIBUTE
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.sim.perturbation import CLEAN, HELD_OUT, MORE_DISTRACTORS, Perturbation, draw, widen
from osel_sim.sim.robots import load_robot

SPLITS = ("train", "validation", "test")
GAP = 0.035
"""Least free distance between two footprints, metres: room for the open fingers of the gripper."""

SHADE = 0.18
"""What stands nearer to the camera than an object by less than this may hide it, metres."""


@dataclass(frozen=True)
class Placement:
    """Where a thing starts: metres on the table, radians about the vertical, and how far its moving part has moved (a share of its travel)."""

    entity: str
    x: float
    y: float
    yaw: float
    opening: float = 0.0


@dataclass(frozen=True)
class Instance:
    """One scene with one instruction.

    Attributes:
        phrasing: which template the instruction was made of, `train-3` or `held_out-1`.
        roles: role -> name of the thing (or attribute) that fills it: first those that the instruction names, in the task file's order.
        placements: everything that is in the scene.
        named: how many of the roles the instruction names, the first ones.
        level, axes: how far it is perturbed, as `osel_sim.formats.levels.split_off` has it.
        perturbation: what it looks like.
        robot: name of the robot. Another one finds the same scene with the same instruction.
    """

    task: str
    seed: int
    level: int
    split: str
    instruction: str
    phrasing: str
    roles: Mapping[str, str]
    placements: tuple[Placement, ...]
    named: int = 2
    axes: str | None = None
    perturbation: Perturbation = CLEAN
    robot: str = DEFAULT_ROBOT

    @property
    def key(self) -> str:
        """Name of the instance, unique over all."""
        return instance_key(self.task, self.split, label(self.level, self.axes), self.seed, self.robot)

    @property
    def other_robot(self) -> str | None:
        """Name of the robot, None where it is the usual one: as journals and logs have it."""
        return None if self.robot == DEFAULT_ROBOT else self.robot

    @property
    def target(self) -> str:
        """What the instruction names first."""
        return next(iter(self.roles.values()))

    @property
    def container(self) -> str:
        """What the instruction names second: where the first goes; empty where it names nothing else."""
        return [*self.roles.values(), "", ""][1] if self.named > 1 else ""


def make_instance(task: TaskSpec, seed: int, level: int = 0, split: str = "test", axes: Mapping[str, int] | None = None) -> Instance:
    """Draw an instance.

    The splits are disjoint by construction: the first placement's x, counted in micrometres, leaves the split's own remainder modulo 3.
    Training and validation instructions use the training phrasings; every other test instruction, on average, uses a held-out one.

    A level perturbs the instance of level 0: roles, and all that the axes leave alone, are the same.

    Args:
        level: of every axis that the task allows.
        axes: axis -> level, where it differs from `level`.

    Raises:
        UsageError: an unknown split, level, axis or robot, an axis that the task does not allow, a negative seed.
    """
    if split not in SPLITS:
        raise UsageError(f"unknown split {split!r}, known: {', '.join(SPLITS)}")
    levels = resolve(level, axes, task.axes, task.name)
    if seed < 0:
        raise UsageError(f"a seed must be 0 or more, got {seed}")
    robot = load_robot(task.robot)
    scene = [_number(task.name), SPLITS.index(split), 0, seed]
    rng = np.random.default_rng(scene)

    def stream(axis: str) -> np.random.Generator:
        return np.random.default_rng([*scene, _number(axis), levels[axis]])

    present, roles = _draw_scene(task, rng)
    placements = _open(task, _place(task, present, rng), rng)
    if number := levels.get("start"):
        placements = _start_elsewhere(task, present, placements, set(roles.values()), number, stream("start"))
    first = placements[0]
    micrometres = math.floor(first.x * 1e6 / 3) * 3 + SPLITS.index(split)
    placements[0] = replace(first, x=micrometres / 1e6)
    if number := levels.get("distractors"):
        placements += _distractors(task, placements, set(roles.values()), number, stream("distractors"))

    held_out = split == "test" and bool(task.held_out) and bool(rng.random() < 0.5)
    template = int(rng.integers(len(task.held_out if held_out else task.train)))
    words = {
        role: _pick(task.attributes[roles[role]] if kind == ATTRIBUTE else task.entity(roles[role]).names, rng) for role, kind in task.roles.items()
    }
    if number := levels.get("phrasing"):
        held_out, template = _rephrase(task, split, held_out, template, HELD_OUT[number], stream("phrasing"))
    level, above = split_off(levels)
    return Instance(
        task=task.name,
        seed=seed,
        level=level,
        split=split,
        instruction=(task.held_out if held_out else task.train)[template].format(**words),
        phrasing=f"{'held_out' if held_out else 'train'}-{template}",
        roles=roles,
        placements=tuple(placements),
        named=len(task.roles),
        axes=above,
        perturbation=draw(levels, [entity.name for entity in task.entities], [entity.name for entity in task.of_kind("object")], robot, stream),
        robot=robot.name,
    )


def _number(name: str) -> int:
    """A name as a part of a random stream's seed."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")


def _rephrase(task: TaskSpec, split: str, held_out: bool, template: int, chance: float, rng: np.random.Generator) -> tuple[bool, int]:
    """Gives way to a held-out phrasing by chance; never outside the test split."""
    new = int(rng.integers(len(task.held_out))) if task.held_out else 0
    if split != "test" or held_out or not task.held_out or rng.random() >= chance:
        return held_out, template
    return True, new


def _start_elsewhere(
    task: TaskSpec, present: list[Entity], placements: list[Placement], named: set[str], level: int, rng: np.random.Generator
) -> list[Placement]:
    """The same things, placed anew in wider regions."""
    wider = replace(task, regions={kind: widen(region, level) for kind, region in task.regions.items()})
    for _ in range(20):
        moved = _place(wider, present, rng)
        if not any(_hides(task, one, other) for one in moved for other in moved if other.entity in named):
            break
    return [replace(one, x=to.x, y=to.y, yaw=to.yaw) for one, to in zip(placements, moved, strict=True)]


def _hides(task: TaskSpec, one: Placement, other: Placement) -> bool:
    """Whether one object may stand between another one and the agentview camera, which looks from along x, wherever an axis moves it."""
    entity = task.entity(one.entity)
    ahead = one.x - other.x
    both = entity.kind == task.entity(other.entity).kind == "object"
    return both and 0.0 < ahead < SHADE and abs(one.y - other.y) < 0.3 * ahead + entity.radius / 2


def _distractors(task: TaskSpec, placements: list[Placement], named: set[str], level: int, rng: np.random.Generator) -> list[Placement]:
    """More objects, in the wider start region, beside what is there; as many as find room."""
    there = [(task.entity(one.entity), one.x, one.y) for one in placements]
    free = [entity for entity in task.of_kind("object") if entity.name not in {one.entity for one in placements}]
    wanted = min(int(rng.integers(MORE_DISTRACTORS[level][0], MORE_DISTRACTORS[level][1] + 1)), len(free))
    added: list[Placement] = []
    for index in rng.permutation(len(free)):
        if len(added) == wanted:
            break
        entity, region = free[index], widen(task.regions["object"], level)
        for _ in range(50):
            new = Placement(entity.name, *(float(rng.uniform(*limits)) for limits in (region.x, region.y, region.yaw)))
            free_spot = all(math.hypot(new.x - x, new.y - y) >= entity.radius + other.radius + _gap(entity, other) for other, x, y in there)
            if free_spot and not any(_hides(task, new, one) for one in placements if one.entity in named):
                there.append((entity, new.x, new.y))
                added.append(new)
                break
    return added


def _pick[T](items: tuple[T, ...] | list[T], rng: np.random.Generator) -> T:
    return items[int(rng.integers(len(items)))]


def _draw_scene(task: TaskSpec, rng: np.random.Generator) -> tuple[list[Entity], dict[str, str]]:
    """Things and roles; drawn anew where no attribute tells the drawn things apart."""
    for _ in range(1000):
        present = _draw_entities(task, rng)
        roles = _draw_roles(task, present, rng)
        if roles is not None:
            return present, roles
    raise UsageError(f"task {task.name!r}: no attribute of the catalogue is had by some of its things and not by others")


def _draw_entities(task: TaskSpec, rng: np.random.Generator) -> list[Entity]:
    """As many objects as the roles and the drawn number of distractors need, and everything of other kinds."""
    objects = task.of_kind("object")
    low, high = task.distractors
    count = [*task.roles.values(), *task.unnamed.values()].count("object") + int(rng.integers(low, high + 1))
    fixed = [index for index, entity in enumerate(objects) if entity.name in task.fixed.values()]
    drawn = [index for index in rng.permutation(len(objects)) if index not in fixed]
    chosen = sorted([*fixed, *drawn][:count])
    return [objects[index] for index in chosen] + [entity for entity in task.entities if entity.kind != "object"]


def _draw_roles(task: TaskSpec, present: list[Entity], rng: np.random.Generator) -> dict[str, str] | None:
    """Role -> name; None where a role is an attribute and none splits the things it is to sort."""
    roles: dict[str, str] = {}
    for role, kind in (*task.roles.items(), *task.unnamed.items()):
        taken = {*roles.values(), *task.fixed.values()} - {task.fixed.get(role)}
        free = [entity.name for entity in present if entity.kind == kind and entity.name not in taken]
        if kind == ATTRIBUTE:
            free = [name for name in task.attributes if len({name in entity.attributes for entity in present if entity.kind == "object"}) == 2]
        if role in task.fixed:
            free = [name for name in free if name == task.fixed[role]]
        if not free:
            return None
        roles[role] = _pick(free, rng)
    for role, rule in task.sorted_roles.items():
        roles[role] = roles[rule.then if roles[rule.attribute] in task.entity(roles[rule.thing]).attributes else rule.otherwise]
    return roles


def _open(task: TaskSpec, placements: list[Placement], rng: np.random.Generator) -> list[Placement]:
    """Draw how far moving parts have moved at the start."""
    starts = {entity.name: task.starts[entity.kind] for entity in task.entities if entity.kind in task.starts}
    return [replace(one, opening=float(rng.uniform(*starts[one.entity]))) if one.entity in starts else one for one in placements]


def _place(task: TaskSpec, present: list[Entity], rng: np.random.Generator) -> list[Placement]:
    """Rejection sampling, largest footprint first; starts over when it paints itself into a corner."""
    order = sorted(range(len(present)), key=lambda index: -present[index].radius)
    for _ in range(1000):
        placed: dict[int, Placement] = {}
        for index in order:
            entity, region = present[index], task.regions[present[index].kind]
            for _ in range(50):
                candidate = Placement(entity.name, *(float(rng.uniform(*limits)) for limits in (region.x, region.y, region.yaw)))
                if all(
                    math.hypot(candidate.x - other.x, candidate.y - other.y) >= entity.radius + present[j].radius + _gap(entity, present[j])
                    for j, other in placed.items()
                ):
                    placed[index] = candidate
                    break
            else:
                break
        if len(placed) == len(present):
            return [placed[index] for index in range(len(present))]
    raise UsageError(f"task {task.name!r}: its regions are too small for {len(present)} things")


def _gap(one: Entity, other: Entity) -> float:
    """What stands fast may stand close together: nothing is grasped between them."""
    return GAP if "object" in (one.kind, other.kind) else 0.005
