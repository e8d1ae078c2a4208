"""Levels and axes: how far an instance is perturbed, and in what. Level 0 is clean; levels 1 to 3 turn up every axis a task allows, or one alone."""

from collections.abc import Iterable, Mapping

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.instance import instance_key as instance_key
from osel_sim.interface.instance import label as label

LEVELS = (0, 1, 2, 3)
AXES = ("light", "camera", "texture", "distractors", "colours", "sizes", "start", "robot", "phrasing")
"""Lamp, camera poses, table top, more objects, tint of things, size of objects, wider start regions, robot's start pose, held-out phrasings."""


def parse_axes(items: Iterable[str], known: Iterable[str] = AXES) -> dict[str, int]:
    """`["camera=2", "light=1"]`, as given on a command line -> {"camera": 2, "light": 1}.

    Args:
        known: names of axes; those of our own tasks by default.

    Raises:
        UsageError: naming the item and what would be right.
    """
    known, result = tuple(known), dict[str, int]()
    for item in items:
        axis, equals, number = item.partition("=")
        if not equals or not number.isdecimal():
            raise UsageError(f"--axis {item!r} must read AXIS=LEVEL, such as camera=2; axes: {', '.join(known)}; levels: {_known(LEVELS)}")
        if result.get(axis, int(number)) != int(number):
            raise UsageError(f"--axis {axis} is given twice, with levels {result[axis]} and {int(number)}")
        result[axis] = int(number)
    for axis, level in result.items():
        _check(axis, level, known)
    return result


def resolve(level: int, axes: Mapping[str, int] | None = None, allowed: Iterable[str] = AXES, task: str = "") -> dict[str, int]:
    """Level of every axis that a task allows.

    Args:
        level: of all axes that `axes` does not name.
        allowed, task: the axes of a task, and its name for the error message.

    Raises:
        UsageError: an unknown level or axis, or one that the task does not allow.
    """
    allowed = tuple(allowed)
    if level not in LEVELS:
        raise UsageError(f"unknown level {level}, known: {_known(LEVELS)}")
    for axis, own in (axes or {}).items():
        _check(axis, own)
        if own and axis not in allowed:
            raise UsageError(f"task {task!r} does not allow the axis {axis!r}; it allows: {', '.join(allowed) or 'none'}")
    return {axis: (axes or {}).get(axis, level) for axis in AXES if axis in allowed}


def split_off(levels: Mapping[str, int]) -> tuple[int, str | None]:
    """The canonical form of `resolve`'s answer: the lowest level, and the axes above it as `camera=2,light=1` (None where there are none).

    Equal settings have equal forms, however they were asked for.
    """
    level = min(levels.values(), default=0)
    above = ",".join(f"{axis}={own}" for axis, own in sorted(levels.items()) if own > level)
    return level, above or None


def _check(axis: str, level: int, known: Iterable[str] = AXES) -> None:
    if axis not in known:
        raise UnknownNameError("axis", axis, known)
    if level not in LEVELS:
        raise UsageError(f"axis {axis!r}: unknown level {level}, known: {_known(LEVELS)}")


def _known(items: Iterable[object]) -> str:
    return ", ".join(map(str, items))
