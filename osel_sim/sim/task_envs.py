"""Environments of several tasks, each built when it is first asked for."""

from collections import OrderedDict
from collections.abc import Iterable
from typing import TYPE_CHECKING

from osel_sim.formats.task_file import TaskSpec

if TYPE_CHECKING:
    from osel_sim.sim.env import TaskEnv


class TaskEnvs:
    """Task name -> environment. Building one takes seconds, and keeping it some 250 MB.

    Args:
        keep: how many are kept at a time, those asked for last; None keeps all.
    """

    def __init__(self, tasks: Iterable[TaskSpec], keep: int | None = None) -> None:
        self._tasks = {task.name: task for task in tasks}
        self._keep = keep
        self._envs: OrderedDict[str, TaskEnv] = OrderedDict()

    def __getitem__(self, name: str) -> "TaskEnv":
        from osel_sim.sim.env import TaskEnv

        if name not in self._envs:
            if self._keep is not None and len(self._envs) >= self._keep:
                self._envs.popitem(last=False)[1].close()
            self._envs[name] = TaskEnv(self._tasks[name])
        self._envs.move_to_end(name)
        return self._envs[name]

    def close(self) -> None:
        """Give the GL contexts back."""
        while self._envs:
            self._envs.popitem()[1].close()
