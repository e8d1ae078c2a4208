"""A task: scene, language, goal, subgoals and the expert's plan of one task family, as code wants them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from osel_sim.formats.catalogue import Catalogue, Entity, load_catalogue
from osel_sim.formats.levels import AXES
from osel_sim.formats.task_schema import Region, Sorting, TaskFile
from osel_sim.formats.terms import ATTRIBUTE, KINDS, Term
from osel_sim.formats.toml_file import load_toml
from osel_sim.interface.robot import DEFAULT_ROBOT


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
        fixed: role -> the thing or property that always fills it; the others are drawn.
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
    fixed: Mapping[str, str] = field(default_factory=dict)

    def entity(self, name: str) -> Entity:
        """The thing of that name."""
        return next(entity for entity in self.entities if entity.name == name)

    def of_kind(self, kind: str) -> tuple[Entity, ...]:
        """All things of a kind."""
        return tuple(entity for entity in self.entities if entity.kind == kind)


def load_task_file(file: Path, catalogue: Catalogue | None = None) -> TaskSpec:
    """Read and check a task file.

    Args:
        catalogue: known things and attributes; None reads the shipped ones.

    Raises:
        ContentError: naming the file, the key and what would be right.
    """
    catalogue = load_catalogue() if catalogue is None else catalogue
    return _spec(load_toml(TaskFile, file, {"catalogue": catalogue}), file, catalogue)


def _spec(task: TaskFile, file: Path, catalogue: Catalogue) -> TaskSpec:
    """The task as code wants it."""
    entities = task.scene.entities(catalogue)
    moving = [kind for kind in KINDS if any(entity.joint for entity in entities if entity.kind == kind)]
    return TaskSpec(
        name=task.name,
        title=task.title,
        version=task.version,
        tags=task.tags,
        horizon=task.horizon,
        arena=task.scene.arena,
        entities=entities,
        distractors=task.scene.distractors,
        regions={kind: task.scene.region[kind] for kind in KINDS if kind in task.scene.region},
        starts={kind: task.scene.start.get(kind, (0.0, 0.0)) for kind in moving},
        roles=task.roles,
        unnamed={role: kind for role, kind in task.unnamed.items() if not isinstance(kind, Sorting)},
        sorted_roles={role: rule for role, rule in task.unnamed.items() if isinstance(rule, Sorting)},
        attributes=catalogue.attributes if ATTRIBUTE in task.roles.values() else {},
        train=task.language.train,
        held_out=task.language.held_out,
        goal=task.goal.all,
        subgoals=tuple(task.subgoals.items()),
        plan=task.expert.plan,
        file=file,
        axes=task.scene.axes,
        robot=task.robot,
        fixed=task.fixed,
    )
