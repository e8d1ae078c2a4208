"""Environments of several tasks, each opened when it is first asked for."""

from collections import OrderedDict
from collections.abc import Iterable

from osel_sim.interface.environment import Environment
from osel_sim.interface.suite import Task


class OpenTasks:
    """Task name -> environment. Opening one of ours takes seconds, and keeping it some 250 MB.

    Args:
        keep: how many are kept at a time, those asked for last; None keeps all.
    """

    def __init__(self, tasks: Iterable[Task], keep: int | None = None) -> None:
        self._tasks = {task.name: task for task in tasks}
        self._keep = keep
        self._envs: OrderedDict[str, Environment] = OrderedDict()

    def __getitem__(self, name: str) -> Environment:
        if name not in self._envs:
            if self._keep is not None and len(self._envs) >= self._keep:
                self._envs.popitem(last=False)[1].close()
            self._envs[name] = self._tasks[name].open()
        self._envs.move_to_end(name)
        return self._envs[name]

    def close(self) -> None:
        """Close all that are open."""
        while self._envs:
            self._envs.popitem()[1].close()
