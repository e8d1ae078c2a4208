"""The task file: its tables and keys, and what must fit together in it."""

import string
from collections.abc import Iterator, Mapping
from dataclasses import field
from typing import Annotated

from pydantic import Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator
from pydantic.dataclasses import dataclass

from osel_sim.formats.catalogue import Catalogue, Entity
from osel_sim.formats.levels import AXES
from osel_sim.formats.terms import ATTRIBUTE, KINDS, PREDICATES, SKILLS, Term, TermOf
from osel_sim.formats.toml_types import (
    TABLE,
    Faults,
    FileName,
    Interval,
    OneOf,
    Texts,
    Version,
    between,
    ordered,
    plain_name,
    quoted,
    refuse,
    unknown_value,
)
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.interface.terms import Signature

Kind = Annotated[str, OneOf(KINDS)]
Predicate = Annotated[Term, TermOf(PREDICATES)]
Skill = Annotated[Term, TermOf(SKILLS)]


@dataclass(frozen=True, config=TABLE)
class Region:
    """Where things of one kind start."""

    x: Interval
    """Range away from the robot, metres; 0 is the middle of the table."""
    y: Interval
    """Range to the left of the robot, metres; 0 is the middle of the table."""
    yaw: Interval = (0.0, 0.0)
    """Range of turns, radians."""


@dataclass(frozen=True, config=TABLE)
class Sorting:
    """A role filled by a rule: with `then` if the thing of role `thing` has the attribute of role `attribute`, else with `otherwise`."""

    thing: str
    """Unnamed role whose thing is looked at."""
    attribute: str
    """Role of kind `attribute` that names the property."""
    then: str
    """Role whose thing fills this one if that has the property."""
    otherwise: str
    """Role whose thing fills this one if it has not."""


def _form(value: object) -> str:
    return "rule" if isinstance(value, dict | Sorting) else "kind"


Unnamed = Annotated[Annotated[Kind, Tag("kind")] | Annotated[Sorting, Tag("rule")], Discriminator(_form)]


@dataclass(frozen=True, kw_only=True, config=TABLE)
class SceneTable:
    """What stands and lies where."""

    arena: Annotated[str, OneOf(("table",))]
    """What everything stands on."""
    objects: Texts = ()
    """Things of the catalogue that lie loose: those that fill roles and those that only lie there are drawn from them."""
    containers: Texts = ()
    """Things of the catalogue that objects are put into. These and the following stand fast and are all there, always."""
    zones: Texts = ()
    """Marks on the table."""
    pegs: Texts = ()
    """Pegs that nuts are put around."""
    drawers: Texts = ()
    """Drawers."""
    buttons: Texts = ()
    """Buttons."""
    doors: Texts = ()
    """Doors."""
    distractors: Annotated[tuple[Annotated[int, between(0, 1000)], Annotated[int, between(0, 1000)]], ordered] = (0, 0)
    """Least and most objects besides those that fill a role."""
    axes: tuple[Annotated[str, OneOf(AXES)], ...] = AXES
    """The axes that levels may turn up in this task."""
    region: dict[Kind, Region]
    """Kind -> where its things start: a table for each kind that is there."""
    start: dict[Kind, Interval] = field(default_factory=dict)
    """Kind with a part that moves -> range its joint starts in, as shares of its travel."""

    @field_validator(*(kind + "s" for kind in KINDS))
    @classmethod
    def _are_in_the_catalogue(cls, names: Texts, info: ValidationInfo) -> Texts:
        if info.context is not None:
            known = [thing.name for thing in info.context["catalogue"].things.values() if thing.kind == str(info.field_name)[:-1]]
            if faults := [((index,), unknown_value(name, known)) for index, name in enumerate(names) if name not in known]:
                refuse(*faults)
        return names

    @model_validator(mode="after")
    def _is_not_empty(self) -> "SceneTable":
        if not any(map(self.names, KINDS)):
            refuse((("objects",), f"the scene is empty; it takes {', '.join(kind + 's' for kind in KINDS)}"))
        return self

    def names(self, kind: str) -> Texts:
        """Things of one kind."""
        names: Texts = getattr(self, kind + "s")
        return names

    def entities(self, catalogue: Catalogue) -> tuple[Entity, ...]:
        """All its things, objects first."""
        return tuple(catalogue.things[name] for kind in KINDS for name in self.names(kind))

    def faults(self, roles: Mapping[str, str], unnamed: Mapping[str, str | Sorting], catalogue: Catalogue) -> Faults:
        """Things that the roles need and that there are not; regions that lack, or are for nothing."""
        filled = [*roles.values(), *unnamed.values()]
        moving = {entity.kind for entity in self.entities(catalogue) if entity.joint}
        for kind in KINDS:
            there, wanted = len(self.names(kind)), filled.count(kind)
            wanted += self.distractors[1] if kind == "object" and wanted else 0
            if there < wanted:
                yield (kind + "s",), f"has {there} {kind}s, the roles and distractors need {wanted}"
            if there and kind not in self.region:
                yield ("region", kind), "is missing, expected a table"
            if kind in self.region and not there:
                yield ("region", kind), f"the scene has no {kind}s"
            if kind in self.start and kind not in moving:
                yield ("start", kind), f"the scene has no {kind}s with a part that moves"


@dataclass(frozen=True, kw_only=True, config=TABLE)
class LanguageTable:
    """Phrasings: each has every role of [roles] in braces, and nothing else, so that it can only be followed by reading it."""

    train: Annotated[Texts, Field(min_length=1)]
    """Phrasings of demonstrations and of instances of any split."""
    held_out: Annotated[Texts, Field(min_length=1)]
    """Phrasings that nothing is trained on."""

    def faults(self, roles: Mapping[str, str]) -> Faults:
        """Phrasings that do not name just these roles, or that are in both lists."""
        wanted = ", ".join(f"{{{plain_name(role)}}}" for role in sorted(roles))
        for key, templates in (("train", self.train), ("held_out", self.held_out)):
            for index, template in enumerate(templates):
                try:
                    fields = {name for _, name, _, _ in string.Formatter().parse(template) if name is not None}
                except ValueError as error:
                    yield (key, index), f"{quoted(template)}: {error}"
                    continue
                if fields != set(roles):
                    yield (key, index), f"{quoted(template)} must name {wanted} and nothing else, so that it can only be followed by reading it"
        for index, template in enumerate(self.held_out):
            if template in self.train:
                yield ("held_out", index), f"repeats a training phrasing: {quoted(template)}"


@dataclass(frozen=True, kw_only=True, config=TABLE)
class GoalTable:
    """When the task is done."""

    all: Annotated[tuple[Predicate, ...], Field(min_length=1)]
    """Predicates that must all hold, such as `in(object, container)`."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class ExpertTable:
    """How the scripted expert does it."""

    plan: tuple[Skill, ...]
    """Skills in order, such as `grasp(object)`."""


type Terms = GoalTable | ExpertTable | dict[str, Term]
"""A table of terms: the goal, the plan, or the subgoals."""


@dataclass(frozen=True, kw_only=True, config=TABLE)
class TaskFile:
    """A task family: one file in tasks/."""

    version: Version
    """Of the format."""
    name: FileName
    """The file's name without `.toml`."""
    title: str
    """One line for listings."""
    tags: Texts = ()
    """Words by which several tasks are asked for at once (`--task tag:WORD`)."""
    horizon: Annotated[int, between(1, 100_000)]
    """Control steps (20 Hz) after which an episode ends."""
    robot: str = DEFAULT_ROBOT
    """The robot that does it, where it is not the usual one."""
    roles: Annotated[dict[str, Annotated[str, OneOf((*KINDS, ATTRIBUTE))]], Field(min_length=1)]
    """Role that an instruction names -> kind of thing that fills it, or `attribute`: a property such as "the red things"."""
    unnamed: dict[str, Unnamed] = field(default_factory=dict)
    """Role that no instruction names -> kind of thing that fills it, or the rule by which another role's thing does."""
    scene: SceneTable
    """What stands and lies where."""
    fixed: dict[str, str] = field(default_factory=dict)
    """Role -> the thing of the scene that always fills it, or for an attribute the property; everything else is drawn as ever."""
    language: LanguageTable
    """What people say."""
    goal: GoalTable
    """When the task is done."""
    subgoals: dict[str, Predicate]
    """Name -> predicate, in the order they are reached."""
    expert: ExpertTable
    """How the scripted expert does it."""

    @field_validator("unnamed")
    @classmethod
    def _rules_fit(cls, unnamed: dict[str, str | Sorting], info: ValidationInfo) -> dict[str, str | Sorting]:
        if "roles" in info.data and (faults := list(_unnamed_faults(unnamed, info.data["roles"]))):
            refuse(*faults)
        return unnamed

    @field_validator("scene")
    @classmethod
    def _fills_the_roles(cls, scene: SceneTable, info: ValidationInfo) -> SceneTable:
        roles, unnamed = info.data.get("roles"), info.data.get("unnamed")
        if info.context is None or roles is None or unnamed is None:
            return scene
        if faults := list(scene.faults(roles, unnamed, info.context["catalogue"])):
            refuse(*faults)
        return scene

    @field_validator("fixed")
    @classmethod
    def _fits_the_roles(cls, fixed: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        roles, unnamed, scene = (info.data.get(key) for key in ("roles", "unnamed", "scene"))
        if info.context is None or roles is None or unnamed is None or scene is None:
            return fixed
        if faults := list(_fixed_faults(fixed, roles, unnamed, scene, info.context["catalogue"])):
            refuse(*faults)
        return fixed

    @field_validator("language")
    @classmethod
    def _names_the_roles(cls, language: LanguageTable, info: ValidationInfo) -> LanguageTable:
        if "roles" in info.data and (faults := list(language.faults(info.data["roles"]))):
            refuse(*faults)
        return language

    @field_validator("goal", "subgoals", "expert")
    @classmethod
    def _are_about_the_roles(cls, terms: Terms, info: ValidationInfo) -> Terms:
        if "roles" in info.data and "unnamed" in info.data:
            kinds = _kinds(info.data["roles"], info.data["unnamed"])
            if faults := [(place, fault) for place, term, known in _terms(terms) for fault in term.faults(known, kinds)]:
                refuse(*faults)
        return terms


def _unnamed_faults(unnamed: Mapping[str, str | Sorting], roles: Mapping[str, str]) -> Faults:
    before: list[str] = []
    for role, value in unnamed.items():
        if role in roles:
            yield (role,), "is a role already"
        if not isinstance(value, Sorting):
            before.append(role)
            continue
        attributes = [name for name, kind in roles.items() if kind == ATTRIBUTE]
        things = [name for name, kind in roles.items() if kind != ATTRIBUTE]
        for key, known in (("thing", before), ("attribute", attributes), ("then", things), ("otherwise", things)):
            if (name := getattr(value, key)) not in known:
                yield (role, key), unknown_value(name, known)


def _fixed_faults(
    fixed: Mapping[str, str], roles: Mapping[str, str], unnamed: Mapping[str, str | Sorting], scene: SceneTable, catalogue: Catalogue
) -> Faults:
    """Roles that there are not or that a rule fills, things that are not in the scene or of another kind, and one thing for two roles."""
    kinds = {**roles, **{role: kind for role, kind in unnamed.items() if not isinstance(kind, Sorting)}}
    filled: dict[str, str] = {}
    for role, name in fixed.items():
        if role not in kinds:
            yield (role,), "is filled by a rule" if role in unnamed else f"is no role; roles: {', '.join(kinds)}"
            continue
        known = list(catalogue.attributes) if kinds[role] == ATTRIBUTE else list(scene.names(kinds[role]))
        if name not in known:
            yield (role,), unknown_value(name, known)
        elif name in filled:
            yield (role,), f"{name!r} fills the role {filled[name]!r} already"
        filled[name] = role


def _kinds(roles: Mapping[str, str], unnamed: Mapping[str, str | Sorting]) -> dict[str, str]:
    """Role -> kind of thing that fills it, for all roles; things sorted by a rule end in a thing of one of the named roles."""
    return {**roles, **{role: roles[value.then] if isinstance(value, Sorting) else value for role, value in unnamed.items()}}


def _terms(terms: Terms) -> Iterator[tuple[tuple[str | int, ...], Term, Mapping[str, Signature]]]:
    """(place, term, known terms) of each term of a table."""
    if isinstance(terms, GoalTable):
        yield from ((("all", index), term, PREDICATES) for index, term in enumerate(terms.all))
    elif isinstance(terms, ExpertTable):
        yield from ((("plan", index), term, SKILLS) for index, term in enumerate(terms.plan))
    else:
        yield from (((name,), term, PREDICATES) for name, term in terms.items())
