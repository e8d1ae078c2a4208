"""Names that packages bring: built-in ones by lazy `module:attribute`, those of other packages through an entry-point group.

Listing names imports nothing; a name is imported when it is loaded.
"""

import functools
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast

from osel_sim.core.errors import MissingPackageError, OselError, UnknownNameError, UsageError


class Registry[T]:
    """Things of one sort by name, such as selectors.

    Args:
        what: the sort, in the singular, for messages.
        group: entry-point group in which other packages offer more. They cannot replace a built-in one.
        built_in: name -> `module:attribute`.
        kind: what a loaded one must be an instance of; None: anything.
    """

    def __init__(self, what: str, group: str, built_in: Mapping[str, str], kind: type[T] | None = None) -> None:
        self.what, self.group = what, group
        self._built_in, self._kind = built_in, kind
        self._loaded: dict[str, T] = {}

    def locations(self) -> dict[str, str]:
        """Name -> `module:attribute` of all there are."""
        return {name: points[0].value for name, points in self._plugins().items()} | dict(self._built_in)

    def others(self) -> list[str]:
        """Names of those that other packages bring, sorted."""
        return sorted(name for name in self._plugins() if name not in self._built_in)

    def __iter__(self) -> Iterator[str]:
        return iter(self.locations())

    def __contains__(self, name: object) -> bool:
        return name in self._built_in or name in self._plugins()

    def load(self, name: str, where: str = "") -> T:
        """Import what has this name.

        Args:
            where: to look for the names there are, for the message.

        Raises:
            UnknownNameError: there is none of that name.
            MissingPackageError: it needs a package that is not installed.
            UsageError: it cannot be imported, is of another kind, or two packages offer it; names the package and the cause.
        """
        if name not in self._built_in:
            return self._import(name, *self._location(name, where))
        if name not in self._loaded:  # predicates are asked for at every control step
            self._loaded[name] = self._import(name, self._built_in[name], "")
        return self._loaded[name]

    def _location(self, name: str, where: str) -> tuple[str, str]:
        """Where a plugin lies, and whose it is."""
        points = self._plugins().get(name)
        if points is None:
            raise UnknownNameError(self.what, name, self, where)
        if len(points) > 1:
            raise UsageError(f"{self.what} {name!r} is offered by several packages: {', '.join(map(_package, points))}; remove all but one")
        return points[0].value, f" of {_package(points[0])}"

    def _import(self, name: str, location: str, source: str) -> T:
        module, _, attribute = location.partition(":")
        try:
            found: Any = functools.reduce(getattr, attribute.split("."), import_module(module))
        except OselError:
            raise
        except ModuleNotFoundError as error:
            raise MissingPackageError(f"{self.what} {name!r}{source}", (error.name or str(error)).partition(".")[0]) from error
        except Exception as error:  # a plugin may raise anything while it is imported
            raise UsageError(f"{self.what} {name!r}{source}: cannot import {location} ({type(error).__name__}: {error})") from error
        if self._kind is not None and not isinstance(found, self._kind):
            raise UsageError(f"{self.what} {name!r}{source}: {location} must be a {self._kind.__name__}, it is a {type(found).__name__}")
        return cast(T, found)

    def _plugins(self) -> dict[str, list[EntryPoint]]:
        return _plugins(self.group, tuple(sys.path))


@functools.lru_cache
def _plugins(group: str, path: tuple[str, ...]) -> dict[str, list[EntryPoint]]:
    """Name -> who offers it. Searching all installed packages takes some 10 ms, hence once for each `sys.path`."""
    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=group):
        found.setdefault(point.name, []).append(point)
    return found


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name} {point.dist.version}" if point.dist is not None else "a package"
