"""Typed errors. Every one of them is the user's to read: commands print its message and exit with `exit_code`."""

import difflib
from collections.abc import Iterable


class OselError(Exception):
    """Base of all errors this package raises on purpose."""

    exit_code = 2


class UsageError(OselError):
    """A command or function was given a value it cannot work with."""


class UnknownNameError(UsageError):
    """A task, policy, encoder, selector ... of that name does not exist."""

    def __init__(self, what: str, name: str, known: Iterable[str], where: str = "") -> None:
        known = sorted(known)
        listing = f"known: {', '.join(known) or 'none'}" + (f" ({where})" if where else "")
        super().__init__(f"unknown {what} {name!r}: {did_you_mean(name, known)}{listing}")


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


class DataError(OselError):
    """A journal, rollout log or dataset cannot be read or does not have the promised form."""


def nearest(name: str, known: Iterable[str], likeness: float = 0.5) -> str | None:
    """The known name that is most like `name`, or None where none is as like it as `likeness`, in [0, 1]."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1, cutoff=likeness)), None)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """`did you mean 'x'? `, or nothing where nothing is near."""
    near = nearest(name, known)
    return f"did you mean {near!r}? " if near is not None else ""
