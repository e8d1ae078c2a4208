"""Code that data may ask for: classes of few packages, and nothing that lies in a model's own repository.

Checkpoints and encoders are data, often a stranger's, and the libraries that load them import what they name. What is installed is trusted; a user
can allow more by `--trust`, for this process and those it starts.
"""

import functools
import importlib
import importlib.util
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from osel_sim.core.errors import CheckpointError, UsageError

VARIABLE = "OSEL_SIM_TRUST"
"""Environment variable with the names allowed, with commas between them; child processes inherit it."""

_MODULE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+|/[^,\n]+", re.ASCII)  # of the hub, or a folder on this machine
_refusing: ContextVar[bool] = ContextVar("refusing", default=False)


class ForeignCodeError(CheckpointError):
    """Data asks for code that nobody allowed."""


def trusted() -> tuple[str, ...]:
    """Modules and repositories that the user allows."""
    return tuple(name for name in (part.strip() for part in os.environ.get(VARIABLE, "").split(",")) if name)


def trust(names: Iterable[str]) -> None:
    """Allow more, here and in child processes: modules (`package.module`, with all below it) and model repositories (`owner/name`, or a folder).

    Raises:
        UsageError: a name is neither.
    """
    names = list(names)
    for name in names:
        if not _MODULE.fullmatch(name) and not _REPOSITORY.fullmatch(name):
            raise UsageError(f"--trust {name!r} is neither a module (package.module) nor a model repository (owner/name, or a folder's whole path)")
    if names:
        os.environ[VARIABLE] = ",".join(dict.fromkeys([*trusted(), *names]))


@contextmanager
def trusting(names: Iterable[str]) -> Iterator[None]:
    """Within, allow more, as `trust` does; what one command was allowed is not the next one's, in a process that calls several.

    Raises:
        UsageError: a name is neither a module nor a repository.
    """
    before = os.environ.get(VARIABLE)
    try:
        trust(names)
        yield
    finally:
        os.environ.pop(VARIABLE, None)
        if before is not None:
            os.environ[VARIABLE] = before


def find_class(path: object, packages: Sequence[str], base: type, outside: Path) -> type:
    """The class that a dotted path of a file names.

    What stands before the last dot is imported only if it lies in an allowed package. The class itself must be defined in one as well: a module that
    imports `subprocess` does not make `subprocess.Popen` one of its classes.

    Args:
        packages: whose classes are allowed, beside those of `trusted()`.
        base: what the class has to be a kind of.
        outside: the folder that is being loaded; no module of an allowed name is taken from it.

    Raises:
        ForeignCodeError: with the reason, but not the place, which only the caller knows.
    """
    shown = repr(path)[:120]
    if not isinstance(path, str) or not _MODULE.fullmatch(path) or "." not in path:
        raise ForeignCodeError(f"names {shown}, which is no class")
    module_name, _, class_name = path.rpartition(".")
    allowed = (*packages, *trusted())
    if not _within(module_name, allowed) or any(part.startswith("__") for part in path.split(".")):
        raise ForeignCodeError(
            f"names {shown}: loading it would run code of {module_name!r}, and only classes of {', '.join(packages)} are allowed; "
            f"if you know what it does, allow it with --trust {module_name}"
        )
    if _lies_in(module_name.partition(".")[0], outside):
        raise ForeignCodeError(f"names {shown}, which would be imported from the folder that is being loaded: {outside}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of an old name, which is nothing that the user wrote
            found = getattr(importlib.import_module(module_name), class_name)
    except Exception as error:  # a module of an allowed package may lack what it imports itself
        raise ForeignCodeError(f"names {shown}, which cannot be imported ({type(error).__name__}: {str(error)[:120]})") from None
    if not isinstance(found, type) or not issubclass(found, base):
        raise ForeignCodeError(f"names {shown}, which is no {base.__name__}")
    if not _within(found.__module__, allowed):
        raise ForeignCodeError(f"names {shown}, which is defined in {found.__module__!r}; allow it with --trust {found.__module__}")
    return found


@contextmanager
def no_foreign_code() -> Iterator[None]:
    """Within, transformers runs no code of a model's repository but of those in `trusted()`, whatever its caller allows.

    LeRobot passes `trust_remote_code=True` for several types of policies and processor steps, with names of tokenizers and backbones that the
    checkpoint chooses.

    Raises:
        ForeignCodeError: such code was asked for.
    """
    dynamic = _guarded()
    token = _refusing.set(True)
    seconds = dynamic.TIME_OUT_REMOTE_CODE if dynamic else 0
    if dynamic:
        dynamic.TIME_OUT_REMOTE_CODE = 0  # it would ask on the terminal
    try:
        yield
    finally:
        _refusing.reset(token)
        if dynamic:
            dynamic.TIME_OUT_REMOTE_CODE = seconds


def what_failed(error: Exception) -> Exception:
    """The refusal that an error came about by, else the error itself: libraries wrap what goes wrong in errors of their own."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, ForeignCodeError):
            return seen
        seen = seen.__cause__ or seen.__context__
    return error


@functools.cache
def _guarded() -> Any:
    """transformers' module through which all code of repositories comes, with its one way in guarded; None where it is not installed."""
    if importlib.util.find_spec("transformers") is None:
        return None
    dynamic: Any = importlib.import_module("transformers.dynamic_module_utils")
    original: Callable[..., str] = dynamic.get_cached_module_file

    @functools.wraps(original)
    def fetch(repository: Any, module_file: str, *args: Any, **options: Any) -> str:
        if _refusing.get() and str(repository) not in trusted():
            raise ForeignCodeError(
                f"the model repository {str(repository)!r} wants its own code {module_file!r} to be run; "
                f"if you know what it does, allow it with --trust {repository}"
            )
        return original(repository, module_file, *args, **options)

    dynamic.get_cached_module_file = fetch
    for name in ("transformers.generation.utils",):  # has its own name for it, if it was imported before
        if name in sys.modules:
            vars(sys.modules[name])[original.__name__] = fetch
    return dynamic


def _within(module: str, packages: Iterable[str]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def _lies_in(package: str, folder: Path) -> bool:
    """Whether a package would be imported from a folder, found out without importing it."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return False
    places = [*([spec.origin] if spec and spec.origin else []), *(spec.submodule_search_locations or [] if spec else [])]
    return any(Path(place).resolve().is_relative_to(folder.resolve()) for place in places)
