"""What a suite is: a family of tasks with a simulator of its own. `docs/suites.md` shows how to write one."""

import contextlib
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from osel_sim.core.errors import MissingPackageError, UnknownNameError, UsageError
from osel_sim.interface.environment import Environment, EnvironmentSpec
from osel_sim.interface.instance import OURS, SPLITS, SUITE_SEPARATOR, Instance


@dataclass(frozen=True)
class SuiteSpec:
    """What a suite is and what it can do.

    Attributes:
        name: what its tasks are prefixed with, `NAME:TASK`.
        title: one line about it.
        levels: of perturbation that it has; 0 is clean.
        splits: of instances that it has.
        axes: of perturbation that its levels turn up; a task may allow fewer.
        packages: distributions whose versions `run.json` keeps.
        install: the command that gets it, told where a package is missing.
        opengl: whether it renders by MuJoCo's OpenGL backend, here or in its host, which `run.json` then keeps and a resumed run must share.
        environments: names of the Python environments of its own that it runs in where it does not fit into this one; none: it always runs here.
        cannot: what it cannot do, a sentence each.
    """

    name: str
    title: str
    levels: tuple[int, ...] = (0,)
    splits: tuple[str, ...] = SPLITS
    axes: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    install: str = ""
    opengl: bool = False
    environments: tuple[str, ...] = ()
    cannot: tuple[str, ...] = ()


@dataclass(frozen=True)
class TaskInfo:
    """What a suite says of one of its tasks.

    Attributes:
        title: one line about it.
        horizon: control steps after which an episode ends.
        digest: changes when the task does (a version, or a digest of its file): a run whose tasks changed is not resumed.
        tags: by which it is chosen, `SUITE:tag:TAG`.
        axes: of perturbation that it allows.
        robot: name of the robot that does it, where the suite has several.
    """

    title: str
    horizon: int
    digest: str
    tags: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    robot: str = ""


class Suite(Protocol):
    """A family of tasks. Tasks are named without the suite here.

    A suite is a small object: listing its tasks imports no simulator, and recording pickles it for its worker processes. What is heavy is made by
    `open`.
    """

    @property
    def spec(self) -> SuiteSpec:
        """What it is and what it can do."""
        ...

    @property
    def tasks(self) -> Mapping[str, TaskInfo]:
        """Its tasks by name."""
        ...

    def specification(self, task: str) -> EnvironmentSpec:
        """What the environment of a task offers policies, without opening it where that is possible."""
        ...

    def instance(self, task: str, seed: int, level: int, split: str, axes: Mapping[str, int]) -> Instance:
        """Draw an instance: the same arguments give the same one, and instances of different splits differ.

        Args:
            level, split: some that the suite has.
            axes: axis that the task allows -> level, where it differs from `level`.
        """
        ...

    def open(self, task: str) -> Environment:
        """Make the environment of a task. Closed by whoever asked for it."""
        ...


@runtime_checkable
class Prepares(Protocol):
    """A suite that has something to do once on a machine, such as compiling, which every worker would do for itself otherwise."""

    def prepare(self) -> None:
        """Do it, unless it is done."""
        ...


@runtime_checkable
class TakesFolder(Protocol):
    """A suite of others to which users add tasks by files: `--tasks DIR` holds them in a folder called as the suite is."""

    def with_files(self, folder: Path) -> "Suite":
        """The same suite with the files of that folder, `DIR/SUITE`.

        Raises:
            ContentError: one of them is wrong.
        """
        ...


NO_SNAPSHOTS = "no snapshots: for every policy the instance is started again from the same seed"
"""What a suite cannot do, of those that can set up no state but the first."""


@dataclass(frozen=True)
class Task:
    """One task of a suite, as everything that consumes tasks knows it.

    Attributes:
        suite: what it belongs to.
        short_name: its name within the suite.
    """

    suite: Suite
    short_name: str

    @property
    def name(self) -> str:
        """Its name over all suites: `SUITE:TASK`, without the suite where that is ours."""
        suite = self.suite.spec.name
        return self.short_name if suite == OURS else f"{suite}{SUITE_SEPARATOR}{self.short_name}"

    @property
    def robot(self) -> str:
        """Name of the robot that does it; empty where the suite has but one."""
        return self.info.robot

    @functools.cached_property
    def info(self) -> TaskInfo:
        """What the suite says of it."""
        return self.suite.tasks[self.short_name]

    @functools.cached_property
    def specification(self) -> EnvironmentSpec:
        """What its environment offers policies.

        Raises:
            MissingPackageError: a package of the suite is not installed.
        """
        with naming_packages(self.suite.spec):
            return self.suite.specification(self.short_name)

    def instance(self, seed: int, level: int = 0, split: str = "test", axes: Mapping[str, int] | None = None) -> Instance:
        """Draw an instance.

        Raises:
            UsageError: a seed below 0, or a level, split or axis that the suite or the task does not have.
        """
        spec, axes = self.suite.spec, dict(axes or {})
        if split not in spec.splits:
            raise UnknownNameError("split", split, spec.splits, f"suite {spec.name}")
        for axis, own in axes.items():
            if own and axis not in self.info.axes:
                raise UsageError(f"task {self.name!r} does not allow the axis {axis!r}; it allows: {', '.join(self.info.axes) or 'none'}")
        for number in (level, *axes.values()):
            if number not in spec.levels:
                raise UsageError(f"unknown level {number}, known: {', '.join(map(str, spec.levels))} (suite {spec.name})")
        if seed < 0:
            raise UsageError(f"a seed must be 0 or more, got {seed}")
        with naming_packages(spec):
            return self.suite.instance(self.short_name, seed, level, split, axes)

    def open(self) -> Environment:
        """Make its environment. Close it after use.

        Raises:
            MissingPackageError: a package of the suite is not installed.
        """
        with naming_packages(self.suite.spec):
            return self.suite.open(self.short_name)


@contextlib.contextmanager
def naming_packages(spec: SuiteSpec) -> Iterator[None]:
    """Turn an import that fails in a suite into an error that names the package and the command that gets it.

    Raises:
        MissingPackageError: instead of ModuleNotFoundError.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or str(error)).partition(".")[0]
        raise MissingPackageError(f"suite {spec.name!r}", package, spec.install) from error
