"""The task and policy files there are, by name: the shipped ones and those of a folder of the user's own."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim.core import content
from osel_sim.core.errors import UnknownNameError, UsageError

if TYPE_CHECKING:  # importing pydantic and building the models takes longer than the help of a command
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.formats.task_file import TaskSpec


def select_tasks(wanted: Sequence[str], extra: Path | None = None) -> "list[TaskSpec]":
    """Our own tasks by name, `tag:TAG` or `all`, each once, in the order asked for. `osel_sim.suites.registry` knows those of other suites, too.

    Raises:
        UsageError: nothing is asked for, or a task of another suite.
        UnknownNameError: with the nearest known name or tag.
        ContentError: a task file is wrong.
    """
    from osel_sim.formats.task_file import load_task_file

    if not wanted:
        raise UsageError(f"--task is missing; known: {', '.join(content.files('tasks', extra))}, tag:TAG, all (python -m osel_sim.run --list)")
    chosen: dict[str, TaskSpec] = {}
    for name in wanted:
        kind, colon, tag = name.partition(":")
        if colon and kind != "tag":
            raise UsageError(f"task {name!r} is of the suite {kind!r}; only osel_sim's own tasks can be used here (python -m osel_sim.run --list)")
        if name == "all" or (colon and kind == "tag"):
            everything = [load_task_file(file) for _, file in sorted(content.files("tasks", extra).items())]
            found = [task for task in everything if name == "all" or tag in task.tags]
            if not found:
                raise UnknownNameError("tag", tag, {tag for task in everything for tag in task.tags}, "python -m osel_sim.run --list")
        else:
            found = [load_task_file(content.find("tasks", name, extra))]
        chosen |= {task.name: task for task in found}
    return list(chosen.values())


def load_policy(name: str, extra: Path | None = None) -> "PolicySpec":
    """Find and read a policy file.

    Raises:
        UnknownNameError: with the nearest known name.
        ContentError: naming the file, the key and what would be right.
    """
    from osel_sim.formats.policy_file import load_policy_file

    return load_policy_file(content.find("policies", name, extra))
