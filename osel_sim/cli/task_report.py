"""What `doctor --task` found, as a table on the terminal."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.cli.console import Table, console, plain
from osel_sim.core.errors import UsageError

if TYPE_CHECKING:
    from osel_sim.formats.task_file import TaskSpec
    from osel_sim.sim.task_check import Attempt


def find_task_file(task: str, folder: Path | None, robot: str | None) -> "tuple[TaskSpec, Path | None]":
    """A task of ours by name or by its file, and the folder of task files that it is in, where that is not ours.

    Raises:
        UsageError: there is none, or it is another suite's.
        ContentError: its file is wrong; with all that is wrong with it.
    """
    from osel_sim.formats.task_file import load_task_file
    from osel_sim.sim.robots import with_robot
    from osel_sim.suites.registry import select_task_files

    if not task.endswith(".toml"):
        return select_task_files([task], folder, robot)[0], folder
    file = Path(task)
    if not file.is_file():
        raise UsageError(f"{task}: there is no such task file")
    return with_robot([load_task_file(file)], robot)[0], file.parent


def print_attempts(task: "TaskSpec", attempts: "Sequence[Attempt]") -> None:
    """The attempts as a table, and how many of them came to the goal."""
    table = Table(f"The scripted expert on {task.name}", ("instance", "instruction", "done", "why not"))
    for attempt in attempts:
        done = plain(f"{attempt.steps} of {task.horizon} steps") if attempt.success else plain("no", "red")
        table.add(attempt.instance, attempt.instruction, done, "\n".join(attempt.reasons))
    console().print(table)
    solved = sum(attempt.success for attempt in attempts)
    console().print(f"{task.file} is well formed; the scripted expert solves {solved} of {len(attempts)} instances")
