"""Typed errors. Every one of them is the user's to read: commands print its message and exit with `exit_code`."""

import difflib
from collections.abc import Callable, Iterable
from typing import Any

from osel_sim.core.shown import shown


class OselError(Exception):
    """Base of all errors this package raises on purpose. Its text may quote what others wrote, and holds neither control characters nor secrets."""

    exit_code = 2

    def __reduce__(self) -> tuple[Callable[..., "OselError"], tuple[Any, ...]]:
        # By default an exception is made again from its message alone, which those with arguments of their own do not take.
        return _restore, (type(self), self.args, self.__dict__)

    def __str__(self) -> str:
        return shown(super().__str__())


class UsageError(OselError):
    """A command or function was given a value it cannot work with."""


class UnknownNameError(UsageError):
    """A task, policy, encoder, selector ... of that name does not exist."""

    def __init__(self, what: str, name: str, known: Iterable[str], where: str = "") -> None:
        known = sorted(known)
        listing = f"known: {', '.join(known) or 'none'}" + (f" ({where})" if where else "")
        super().__init__(f"unknown {what} {name!r}: {did_you_mean(name, known)}{listing}")


class MissingPackageError(UsageError):
    """Something was asked for that needs a package which is not installed."""

    def __init__(self, what: str, package: str, install: str = "") -> None:
        super().__init__(f"{what} needs the package {package!r}, which is not installed: {install or f'pip install {package}'}")


class ContentError(OselError):
    """A task, policy or other TOML file is wrong. The message has a line for each fault: the file, the key and what would be right.

    Attributes:
        faults: (key, problem) of each.
    """

    def __init__(self, file: object, key: str, problem: str, *more: tuple[str, str]) -> None:
        self.faults = ((key, problem), *more)
        super().__init__("\n".join(f"{file}: {key}: {problem}" for key, problem in self.faults))


class CheckpointError(OselError):
    """A checkpoint is missing, unreadable or does not fit its policy file."""


class PolicyError(OselError):
    """A policy's answer does not have the promised form."""


class DisplayError(OselError):
    """No headless OpenGL backend works."""


class RemoteError(OselError):
    """A policy server cannot be started or reached, or broke the protocol."""


class SuiteHostError(OselError):
    """The process that runs a suite's environments cannot be started, has ended, or its simulator failed."""


class DataError(OselError):
    """A journal, rollout log or dataset cannot be read or does not have the promised form."""


class DivergedError(OselError):
    """A training's loss or gradient is no finite number any more."""

    exit_code = 1


class BudgetError(OselError):
    """What is left of a budget pays for no policy any more, and none is free."""

    exit_code = 4


class WorkerError(OselError):
    """Worker processes keep dying, so the work cannot go on. The message names how the last one ended."""


class SettingError(UsageError):
    """A setting of a command has a value it cannot work with. The command line shows the setting as a flag.

    Attributes:
        setting: name of the setting.
        problem: what is wrong with its value.
    """

    def __init__(self, setting: str, problem: str) -> None:
        super().__init__(f"{setting}: {problem}" if setting else problem)
        self.setting, self.problem = setting, problem


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`did you mean 'x'? `, or nothing where nothing is near."""
    near = nearest(name, known)
    return f"did you mean {near[0]!r}? " if near else ""


def nearest(name: str, known: Iterable[str], count: int = 1, cutoff: float = 0.5) -> list[str]:
    """The known names most like `name`, the best first.

    Args:
        count: at most so many.
        cutoff: least likeness, in [0, 1]; 0 takes the nearest however far it is.
    """
    return difflib.get_close_matches(name, list(known), n=count, cutoff=cutoff)


def _restore(kind: type[OselError], arguments: tuple[Any, ...], state: dict[str, Any]) -> OselError:
    error = kind.__new__(kind, *arguments)
    error.__dict__.update(state)
    return error
