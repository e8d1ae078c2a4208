"""Which robot decides on which instances."""

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError

By = Literal["task", "level", "robot"]


def groups(values: Sequence[object], robots: int, by: By) -> dict[object, int]:
    """Value -> the robot it belongs to: in the order of the values, in turn.

    Args:
        values: such as the task of each instance.

    Raises:
        UsageError: there are fewer different ones than robots.
    """
    different = sorted(set(values), key=lambda value: (value is not None, str(value)))
    if len(different) < robots:
        known = ", ".join("unknown" if value is None else str(value) for value in different)
        raise UsageError(f"--robots {robots} --robots-by {by}: there {'is' if len(different) == 1 else 'are'} only {len(different)} ({known})")
    return {value: number % robots for number, value in enumerate(different)}


class HasArm(Protocol):
    """A task, and the arm that does it."""

    @property
    def name(self) -> str:
        """Name of the task."""
        ...

    @property
    def robot(self) -> str:
        """Name of the arm."""
        ...


def robots_share[T: HasArm](tasks: Sequence[T], levels: Sequence[int], robot: int, robots: int, by: By | None) -> tuple[Sequence[T], Sequence[int]]:
    """Tasks and levels of which a robot's instances are drawn: all, or of what they differ in its own part.

    Raises:
        UsageError: as `groups`.
    """
    if by is None:
        return tasks, levels
    if by == "level":
        owner = groups(levels, robots, by)
        return tasks, [level for level in levels if owner[level] == robot]
    values = [task.name if by == "task" else task.robot for task in tasks]
    owner = groups(values, robots, by)
    return [task for task, value in zip(tasks, values, strict=True) if owner[value] == robot], levels


def deal(owners: NDArray[np.int64] | None, order: NDArray[np.int32], robots: int) -> NDArray[np.int64]:
    """Places in a stream at which each robot decides, (rounds, robots), each robot's in the stream's order.

    All make as many decisions as the one with the fewest instances has; what others have beyond is left out, so that in every round all decide.

    Args:
        owners: (N,) robot of every instance of the log; None: instances are dealt out in turn.
        order: (T,) the stream, as rows of the log.
    """
    mine = np.arange(len(order)) % robots if owners is None else owners[order]
    places = [np.flatnonzero(mine == robot) for robot in range(robots)]
    rounds = min(map(len, places))
    if not rounds:
        raise UsageError(f"--robots {robots}: a stream of {len(order)} instances leaves a robot without any; ask for fewer robots or more decisions")
    return np.stack([own[:rounds] for own in places], axis=1)
