"""A task: scene, language, goal, subgoals and the expert's plan of one task family, as code wants them (task_schema has the file)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic.dataclasses import dataclass as pydantic_dataclass

from osel_sim.formats.levels import AXES
from osel_sim.formats.terms import Term
from osel_sim.formats.toml_types import TABLE, Interval

if TYPE_CHECKING:
    from osel_sim.formats.catalogue import Catalogue

ATTRIBUTE = "attribute"
"""Kind of a role that names a property (a rule such as "the red things") instead of a thing."""


@pydantic_dataclass(frozen=True, config=TABLE)
class Region:
    """Where things of one kind start."""

    x: Interval
    """Range away from the robot, metres; 0 is the middle of the table."""
    y: Interval
    """Range to the left of the robot, metres; 0 is the middle of the table."""
    yaw: Interval = (0.0, 0.0)
    """Range of turns, radians."""


@pydantic_dataclass(frozen=True, config=TABLE)
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


@dataclass(frozen=True)
class Entity:
    """A thing of the catalogue that takes part in a task (osel_sim.formats.catalogue explains the fields).

    One type for all kinds, so that code may ask any thing for any of it; what a kind does not have is 0, empty or no text.
    """

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
class TaskSpec:
    """One task file as code wants it: things and properties are those of the catalogue, roles told apart by how they are filled.

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
    from osel_sim.formats.task_schema import TaskFile
    from osel_sim.formats.toml_file import load_toml

    catalogue = load_catalogue() if catalogue is None else catalogue
    return load_toml(TaskFile, file, {"catalogue": catalogue}).spec(file, catalogue)
