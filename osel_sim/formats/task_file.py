"""A task file: scene, language, goal, subgoals and the expert's plan of one task family."""

import string
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core.errors import ContentError
from osel_sim.formats.levels import AXES
from osel_sim.formats.terms import KINDS, PREDICATES, SKILLS, Term, parse_term
from osel_sim.formats.validate import Table
from osel_sim.interface.robot import DEFAULT_ROBOT

if TYPE_CHECKING:
    from osel_sim.formats.catalogue import Catalogue

ARENAS = ("table",)
ATTRIBUTE = "attribute"
"""Kind of a role that names a property (a rule such as "the red things") instead of a thing."""


@dataclass(frozen=True)
class Region:
    """Where things of one kind start: ranges in metres on the table and radians."""

    x: tuple[float, float]
    y: tuple[float, float]
    yaw: tuple[float, float]


@dataclass(frozen=True)
class Entity:
    """A thing of the catalogue that takes part in a task (assets/objects/objects.toml explains the fields)."""

    name: str
    kind: str
    names: tuple[str, ...]
    model: str
    radius: float
    size: tuple[float, ...] = ()
    rgba: tuple[float, ...] = ()
    grasp: float = 0.0
    inner: float = 0.0
    rim: float = 0.0
    floor: float = 0.0
    symmetry: int = 180
    handle: str = ""
    inside: str = ""
    lean: float = 0.0
    joint: str = ""
    attributes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Sorting:
    """A role filled by a rule: with `then` if the thing of role `thing` has the attribute of role `attribute`, else with `otherwise`."""

    thing: str
    attribute: str
    then: str
    otherwise: str


@dataclass(frozen=True)
class TaskSpec:
    """One task file, validated.

    Attributes:
        horizon: control steps (20 Hz) after which an episode ends.
        entities: everything that can be in the scene, objects first.
        distractors: least and most objects besides those that fill a role.
        regions: kind -> where its things start.
        starts: kind with a moving part -> range its joint starts in, as shares of its travel.
        roles: role that an instruction names -> kind of thing that fills it, or `attribute`.
        unnamed: role that no instruction names -> kind.
        sorted_roles: roles filled by a rule.
        attributes: property -> what people call the things that have it.
        train, held_out: phrasings with `{role}` fields.
        goal: predicates that must all hold.
        subgoals: (name, predicate), in the order they are reached.
        plan: the scripted expert's skills.
        axes: the axes that levels may turn up in this task.
        robot: name of the robot that does it (`osel_sim.sim.robots`).
    """

    name: str
    title: str
    version: int
    tags: tuple[str, ...]
    horizon: int
    arena: str
    entities: tuple[Entity, ...]
    distractors: tuple[int, int]
    regions: Mapping[str, Region]
    starts: Mapping[str, tuple[float, float]]
    roles: Mapping[str, str]
    unnamed: Mapping[str, str]
    sorted_roles: Mapping[str, Sorting]
    attributes: Mapping[str, tuple[str, ...]]
    train: tuple[str, ...]
    held_out: tuple[str, ...]
    goal: tuple[Term, ...]
    subgoals: tuple[tuple[str, Term], ...]
    plan: tuple[Term, ...]
    file: Path
    axes: tuple[str, ...] = AXES
    robot: str = DEFAULT_ROBOT

    def entity(self, name: str) -> Entity:
        """The thing of that name."""
        return next(entity for entity in self.entities if entity.name == name)

    def of_kind(self, kind: str) -> tuple[Entity, ...]:
        """All things of a kind."""
        return tuple(entity for entity in self.entities if entity.kind == kind)


def load_task_file(file: Path, catalogue: "Catalogue | None" = None) -> TaskSpec:
    """Read and check a task file.

    Args:
        catalogue: known things and attributes; None reads the shipped ones.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    from osel_sim.formats.catalogue import load_catalogue

    catalogue = load_catalogue() if catalogue is None else catalogue
    table = Table.load(file)
    version = table.integer("version", 1, 1)
    name = table.get("name", str)
    if name != file.stem:
        raise ContentError(file, "name", f"must equal the file's name {file.stem!r}, got {name!r}")
    scene = table.table("scene")
    entities = _entities(scene, catalogue)
    distractors = scene.interval("distractors", [0, 0])
    kinds_used = [kind for kind in KINDS if any(entity.kind == kind for entity in entities)]
    regions = scene.table("region")
    region_of = {kind: _region(regions.table(kind)) for kind in kinds_used}
    regions.done()
    starts = scene.table("start", {})
    start_of = {kind: starts.interval(kind, [0.0, 0.0]) for kind in kinds_used if any(e.joint for e in entities if e.kind == kind)}
    starts.done()

    role_table, unnamed_table = table.table("roles"), table.table("unnamed", {})
    roles = {role: role_table.choice(role, (*KINDS, ATTRIBUTE)) for role in role_table.data}
    if not roles:
        raise table.error("roles", "needs at least one role")
    unnamed, sorted_roles = _unnamed(unnamed_table, roles)
    filled = [*roles.values(), *unnamed.values()]
    for kind in set(filled) - {ATTRIBUTE}:
        wanted = filled.count(kind) + (int(distractors[1]) if kind == "object" else 0)
        if (there := sum(entity.kind == kind for entity in entities)) < wanted:
            raise scene.error(kind + "s", f"has {there} {kind}s, the roles and distractors need {wanted}")
    language = table.table("language")
    phrasings = {key: language.strings(key) for key in ("train", "held_out")}
    for key, templates in phrasings.items():
        _check_phrasings(language, key, templates, set(roles))
    if shared := set(phrasings["train"]) & set(phrasings["held_out"]):
        raise language.error("held_out", f"repeats a training phrasing: {sorted(shared)[0]!r}")

    goal, subgoals, expert = table.table("goal"), table.table("subgoals"), table.table("expert")
    kinds = {**roles, **unnamed, **{role: roles[rule.then] for role, rule in sorted_roles.items()}}
    spec = TaskSpec(
        name=name,
        title=table.get("title", str),
        version=version,
        tags=table.strings("tags", []),
        horizon=table.integer("horizon", 1, 100_000),
        arena=scene.choice("arena", ARENAS),
        entities=entities,
        distractors=(int(distractors[0]), int(distractors[1])),
        regions=region_of,
        starts=start_of,
        roles=roles,
        unnamed=unnamed,
        sorted_roles=sorted_roles,
        attributes=catalogue.attributes if ATTRIBUTE in roles.values() else {},
        train=phrasings["train"],
        held_out=phrasings["held_out"],
        goal=tuple(parse_term(goal, "all", text, PREDICATES, kinds) for text in goal.strings("all")),
        subgoals=tuple((key, parse_term(subgoals, key, subgoals.get(key, str), PREDICATES, kinds)) for key in subgoals.data),
        plan=tuple(parse_term(expert, "plan", text, SKILLS, kinds) for text in expert.strings("plan")),
        file=file,
        axes=_axes(scene),
        robot=table.get("robot", str, DEFAULT_ROBOT),
    )
    for section in (table, scene, language, goal, expert):
        section.done()
    return spec


def _entities(scene: Table, catalogue: "Catalogue") -> tuple[Entity, ...]:
    entities: list[Entity] = []
    for kind in KINDS:
        known = [entity.name for entity in catalogue.things.values() if entity.kind == kind]
        for item in scene.strings(kind + "s", []):
            scene.one_of(kind + "s", item, known)
            entities.append(catalogue.things[item])
    if not entities:
        raise scene.error("objects", f"the scene is empty; it takes {', '.join(kind + 's' for kind in KINDS)}")
    return tuple(entities)


def _unnamed(table: Table, roles: Mapping[str, str]) -> tuple[dict[str, str], dict[str, Sorting]]:
    """Roles that no instruction names: kinds, and roles filled by a rule."""
    unnamed: dict[str, str] = {}
    rules: dict[str, Sorting] = {}
    for role, value in table.data.items():
        if role in roles:
            raise table.error(role, "is a role already")
        if isinstance(value, dict):
            rule = table.table(role)
            named = {kind: [name for name, other in roles.items() if (other == ATTRIBUTE) == (kind == ATTRIBUTE)] for kind in (ATTRIBUTE, "thing")}
            rules[role] = Sorting(
                rule.choice("thing", tuple(unnamed)),
                rule.choice("attribute", tuple(named[ATTRIBUTE])),
                rule.choice("then", tuple(named["thing"])),
                rule.choice("otherwise", tuple(named["thing"])),
            )
            rule.done()
        else:
            unnamed[role] = table.choice(role, KINDS)
    return unnamed, rules


def _axes(scene: Table) -> tuple[str, ...]:
    axes = scene.strings("axes", list(AXES))
    for axis in axes:
        scene.one_of("axes", axis, AXES)
    return axes


def _region(table: Table) -> Region:
    region = Region(table.interval("x"), table.interval("y"), table.interval("yaw", [0.0, 0.0]))
    table.done()
    return region


def _check_phrasings(table: Table, key: str, templates: tuple[str, ...], roles: set[str]) -> None:
    if not templates:
        raise table.error(key, "needs at least one phrasing")
    for template in templates:
        try:
            fields = {field for _, field, _, _ in string.Formatter().parse(template) if field is not None}
        except ValueError as error:
            raise table.error(key, f"{template!r}: {error}") from None
        if fields != roles:
            wanted = ", ".join(f"{{{role}}}" for role in sorted(roles))
            raise table.error(key, f"{template!r} must name {wanted} and nothing else, so that it can only be followed by reading it")
