"""Our own suite: task files in robosuite scenes, behind the interface that all suites have."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core import content
from osel_sim.core.files import digest
from osel_sim.formats.levels import AXES, LEVELS
from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.instance import OURS, SPLITS
from osel_sim.interface.specification import specification
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.sim.robots import load_robot, with_robot

if TYPE_CHECKING:
    from osel_sim.sim.env import TaskEnv
    from osel_sim.sim.instance import Instance


class TaskFiles(Mapping[str, TaskInfo]):
    """Tasks by name, each file read when it is asked for: a wrong file spoils no other task.

    Args:
        folder: task files of the user's own.
        robot: that does all tasks; None: each as its file says.
    """

    def __init__(self, folder: Path | None, robot: str | None = None) -> None:
        self._folder, self._robot = folder, robot
        self._specs: dict[str, TaskSpec] = {}

    def spec(self, name: str) -> TaskSpec:
        """The task file of that name.

        Raises:
            UnknownNameError: there is none.
            ContentError: it is wrong, or names a robot that there is not.
        """
        if name not in self._specs:
            self._specs[name] = with_robot([load_task_file(content.find("tasks", name, self._folder))], self._robot)[0]
        return self._specs[name]

    def __getitem__(self, name: str) -> TaskInfo:
        spec = self.spec(name)
        return TaskInfo(spec.title, spec.horizon, digest(spec.file), spec.tags, spec.axes, spec.robot)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(content.files("tasks", self._folder)))

    def __len__(self) -> int:
        return len(content.files("tasks", self._folder))


class OurSuite:
    """The suite of the task files.

    Args:
        folder: task files of the user's own.
        robot: that does all tasks; None: each as its file says.

    Raises:
        UnknownNameError: there is no such robot.
    """

    spec = SuiteSpec(OURS, "Task files in robosuite scenes", LEVELS, SPLITS, AXES, opengl=True)

    def __init__(self, folder: Path | None = None, robot: str | None = None) -> None:
        if robot is not None:
            load_robot(robot)
        self.tasks = TaskFiles(folder, robot)

    def specification(self, task: str) -> EnvironmentSpec:
        """What the environment of a task offers policies."""
        spec = self.tasks.spec(task)
        return specification(spec.robot, spec.horizon)

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> "Instance":
        """Draw an instance (`osel_sim.sim.instance.make_instance`)."""
        from osel_sim.sim.instance import make_instance

        return make_instance(self.tasks.spec(task), seed, level, split, axes)

    def prepare(self) -> None:
        """Compile the control of the arm."""
        from osel_sim.sim.osc import prepare

        prepare()

    def open(self, task: str) -> "TaskEnv":
        """Make the environment of a task; takes seconds."""
        from osel_sim.sim.env import TaskEnv

        return TaskEnv(self.tasks.spec(task))
