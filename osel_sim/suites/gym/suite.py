"""Any gymnasium environment whose info says whether the task is done, as a suite: `gym:FetchPush-v4`, `gym:my_module:Mine-v0`."""

import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path

from osel_sim.core.files import content_digest
from osel_sim.interface.suite import NO_SNAPSHOTS, SuiteSpec, TaskInfo
from osel_sim.suites.described import DescribedSuite, Phrasings
from osel_sim.suites.environments import environment
from osel_sim.suites.gym.tasks import GymTask, load_tasks

NAME = "gym"


class Gym(DescribedSuite):
    """The suite.

    Args:
        folder: the user's own files about gymnasium environments.
    """

    spec = SuiteSpec(
        NAME,
        "gymnasium environments whose info says is_success or success",
        packages=("gymnasium", "gymnasium-robotics", "mujoco", "numpy"),
        install=environment(NAME).command,
        opengl=True,
        environments=(NAME,),
        cannot=(NO_SNAPSHOTS, "no perturbation levels"),
    )

    def __init__(self, folder: Path | None = None) -> None:
        super().__init__()
        self._files = load_tasks(folder)

    def with_files(self, folder: Path) -> "Gym":
        """The suite with a user's own files."""
        return Gym(folder)

    @functools.cached_property
    def _listed(self) -> dict[str, TaskInfo]:
        return {
            name: TaskInfo(task.title or name, task.horizon or int(self.describe(name)["specification"]["horizon"]), _digest(task), task.tags)
            for name, task in self._files.items()
        }

    def listed(self) -> Mapping[str, TaskInfo]:
        """Those of which there is a file."""
        return self._listed

    def phrasings(self, task: str) -> Phrasings:
        """As its file says."""
        file = self._files.get(task)
        return (file.train, file.held_out) if file else ((), ())

    def packed(self, task: str) -> str:
        """All that its file says, for the module that makes it."""
        return self._files.get(task, GymTask(task)).packed()

    def runs_here(self, task: str) -> bool:
        """Whether this Python knows it: others are looked for in the suite's own environment."""
        return _known_here(task)


@functools.cache
def _known_here(name: str) -> bool:
    module, colon, _ = name.partition(":")
    if colon:
        return importlib.util.find_spec(module) is not None
    import gymnasium

    return name in gymnasium.registry


def _digest(task: GymTask) -> str:
    return content_digest(task.packed())[:12]
