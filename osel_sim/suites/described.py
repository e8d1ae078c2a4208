"""Suites whose tasks nobody lists: any name will do, and what it stands for only the simulator knows."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

from osel_sim.core.files import content_digest
from osel_sim.interface.environment import Environment, EnvironmentSpec
from osel_sim.interface.suite import SuiteSpec, TaskInfo
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.hosted import describe, open_environment
from osel_sim.suites.phrasing import phrase, stream, words_of

Phrasings = tuple[tuple[str, ...], tuple[str, ...]]
"""Training phrasings, and held-out ones."""


class DescribedSuite(ABC):
    """A suite whose environments describe themselves when they are first asked for; what they say is kept."""

    spec: SuiteSpec

    def __init__(self) -> None:
        self.tasks: Mapping[str, TaskInfo] = _AnyTask(self)
        self._described: dict[str, dict[str, Any]] = {}

    # -- a suite's own -------------------------------------------------------------------------------------------------

    @abstractmethod
    def listed(self) -> Mapping[str, TaskInfo]:
        """Tasks that are known by name; others may be there."""

    @abstractmethod
    def phrasings(self, task: str) -> Phrasings:
        """Phrasings of the instruction; none where nobody wrote any."""

    def packed(self, task: str) -> str:
        """What the suite's module is told to make."""
        return task

    def place(self, task: str) -> str:
        """The Python environment that a task needs."""
        return self.spec.name

    def runs_here(self, task: str) -> bool:
        """Whether a task runs in this process, whatever is installed elsewhere."""
        return False

    # -- the same for all ----------------------------------------------------------------------------------------------

    def describe(self, task: str) -> dict[str, Any]:
        """What the environment says of itself."""
        if task not in self._described:
            self._described[task] = describe(self.spec.name, self.packed(task), self.place(task), self.runs_here(task))
        return self._described[task]

    def specification(self, task: str) -> EnvironmentSpec:
        """What the environment of a task offers policies."""
        return EnvironmentSpec.from_dict(self.describe(task)["specification"])

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> PlainInstance:
        """Draw an instance: a seed for the simulator, and a phrasing."""
        train, held_out = self.phrasings(task)
        said = str(self.describe(task)["instruction"]) if not train else ""
        phrasing, instruction = phrase(train or (said or words_of(task),), held_out, split, stream(task, seed, split))
        return PlainInstance(f"{self.spec.name}:{task}", seed, split, instruction, level, phrasing=phrasing)

    def open(self, task: str) -> Environment:
        """Make the environment of a task."""
        return open_environment(self.spec.name, self.packed(task), self.place(task), self.runs_here(task))


class _AnyTask(Mapping[str, TaskInfo]):
    """The tasks of such a suite: those that are listed, and any other by its name."""

    def __init__(self, suite: DescribedSuite) -> None:
        self._suite = suite

    def __getitem__(self, name: str) -> TaskInfo:
        listed = self._suite.listed()
        if name in listed:
            return listed[name]
        spec = self._suite.specification(name)
        return TaskInfo(words_of(name), spec.horizon or 0, content_digest(repr(self._suite.describe(name)))[:12])

    def __iter__(self) -> Iterator[str]:
        return iter(self._suite.listed())

    def __len__(self) -> int:
        return len(self._suite.listed())
