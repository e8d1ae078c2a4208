"""Suites and their tasks by name.

Suites of others come by the entry-point group `osel_sim.suites` and are imported when one of their tasks is named. An entry point's name is the
suite's; its value, `module:attribute`, is called without arguments and returns the suite (`osel_sim.interface.suite`).
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.instance import OURS, SUITE_SEPARATOR
from osel_sim.interface.suite import Suite, TakesFolder, Task
from osel_sim.suites import SUITES

ALL, TAG = "all", "tag"
RESERVED = (ALL, TAG, "skill")
"""Not for suites of others: `skill:` begins the keys of examples among the contexts of instances."""
LISTING = "python -m osel_sim.run --list"


def load_suite(name: str, folder: Path | None = None, robot: str | None = None) -> Suite:
    """A suite by name.

    Args:
        folder: task files of the user's own: for our suite, and in a folder called as it is for a suite that takes some.
        robot: that does all tasks of our suite; None: each task's own.

    Raises:
        UnknownNameError: there is none of that name.
        MissingPackageError: importing it needs a package that is not installed.
        UsageError: its entry point does not lead to a suite of that name, or a suite of others is asked for a robot.
    """
    if name in RESERVED:
        raise UsageError(f"{name!r} is no name for a suite: it means something else in names of tasks")
    make = SUITES.load(name, f"the suite stands before the colon, as in SUITE:TASK; {LISTING}")
    if name == OURS:
        ours: Suite = make(folder, robot)
        return ours
    if robot is not None:
        raise UsageError(f"suite {name!r} has its own robot: leave --robot out")
    try:
        suite: Suite = make()
        found = suite.spec.name
    except (AttributeError, TypeError) as error:
        raise UsageError(f"suite {name!r}: {SUITES.locations()[name]} makes no suite ({type(error).__name__}: {error})") from error
    if found != name:
        raise UsageError(f"suite {name!r}: {SUITES.locations()[name]} makes one that calls itself {found!r}")
    if folder is not None and isinstance(suite, TakesFolder) and (folder / name).is_dir():
        return suite.with_files(folder / name)
    return suite


def find_task(name: str, folder: Path | None = None, robot: str | None = None) -> Task:
    """A task by name: `TASK` of ours, `SUITE:TASK` of another suite.

    Args:
        folder, robot: as `load_suite` takes them.

    Raises:
        UnknownNameError: with the nearest known name.
        ContentError: its file is wrong.
        MissingPackageError: its suite needs a package that is not installed.
    """
    suite_name, short = _split(name)
    suite = load_suite(suite_name, folder, robot)
    if suite.tasks.get(short) is None:
        raise UnknownNameError("task", name, [Task(suite, known).name for known in suite.tasks], LISTING)
    return Task(suite, short)


def select_tasks(wanted: Sequence[str], folder: Path | None = None, robot: str | None = None) -> list[Task]:
    """Tasks by name, each once, in the order asked for.

    Names are `TASK`, `tag:TAG` or `all` of ours, and `SUITE:TASK`, `SUITE:tag:TAG` or `SUITE:all` of another suite.

    Args:
        folder, robot: as `load_suite` takes them.

    Raises:
        UsageError: nothing is asked for.
        UnknownNameError: with the nearest known suite, task or tag.
        ContentError: a task file is wrong.
        MissingPackageError: a suite needs a package that is not installed.
    """
    if not wanted:
        known = ", ".join(load_suite(OURS, folder).tasks)
        raise UsageError(f"--task is missing; known: {known}, tag:TAG, all ({LISTING})")
    chosen: dict[str, Task] = {}
    for name in wanted:
        chosen |= {task.name: task for task in _named(name, folder, robot)}
    return list(chosen.values())


def select_task_files(wanted: Sequence[str], folder: Path | None = None, robot: str | None = None) -> list[TaskSpec]:
    """Task files by name, as `select_tasks` takes them, for what works on our own tasks only.

    Raises:
        UsageError: a task of another suite; otherwise as `select_tasks`.
    """
    files = []
    for task in select_tasks(wanted, folder, robot):
        if task.suite.spec.name != OURS:
            raise UsageError(f"task {task.name!r} is of the suite {task.suite.spec.name!r}; only osel_sim's own tasks can be used here ({LISTING})")
        files.append(task.suite.tasks.spec(task.short_name))  # type: ignore[attr-defined]  # our suite's tasks are files
    return files


def common_specification(tasks: Iterable[Task]) -> EnvironmentSpec:
    """What the environments of all these tasks offer policies: the same policies drive in all of them.

    Raises:
        UsageError: they differ.
    """
    first, *others = tasks
    for other in others:
        if not first.specification.drives_like(other.specification):
            raise UsageError(
                f"{first.name} and {other.name} cannot be mixed: their environments differ in actions, state, cameras or control rate "
                f"({first.specification.name}, {other.specification.name}); run them apart"
            )
    return first.specification


def known_axes(tasks: Iterable[Task]) -> list[str]:
    """Axes of perturbation that some of the tasks' suites have, whether or not these tasks allow them; in the suites' order."""
    suites = {task.suite.spec.name: task.suite for task in tasks}
    return list(dict.fromkeys(axis for suite in suites.values() for axis in suite.spec.axes))


def _named(name: str, folder: Path | None, robot: str | None) -> list[Task]:
    """The tasks that one name stands for."""
    suite_name, short = _split(name)
    tag = short.removeprefix(f"{TAG}{SUITE_SEPARATOR}")
    if short != ALL and tag == short:
        return [find_task(name, folder, robot)]
    suite = load_suite(suite_name, folder, robot)
    tasks = dict(suite.tasks)
    found = [Task(suite, known) for known, info in tasks.items() if short == ALL or tag in info.tags]
    if not found:
        raise UnknownNameError("tag", tag, {tag for info in tasks.values() for tag in info.tags}, LISTING)
    return found


def _split(name: str) -> tuple[str, str]:
    """Suite, and what is asked of it. Only the first colon counts: names of gymnasium's environments may hold one."""
    suite, colon, short = name.partition(SUITE_SEPARATOR)
    return (suite, short) if colon and suite != TAG else (OURS, name)
