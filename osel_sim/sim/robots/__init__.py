"""Robots by name: one file a robot. Listing them imports none."""

from collections.abc import Sequence
from dataclasses import replace

from osel_sim.core.errors import ContentError, UnknownNameError, UsageError
from osel_sim.core.registry import Registry
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.robot import Robot

ENTRY_POINTS = "osel_sim.robots"
"""Entry-point group in which other packages offer robots: `name = "module:ROBOT"`."""

BUILT_IN = {
    "Kinova3": "osel_sim.sim.robots.kinova3:KINOVA3",
    "Panda": "osel_sim.sim.robots.panda:PANDA",
    "UR5e": "osel_sim.sim.robots.ur5e:UR5E",
}

ROBOTS = Registry("robot", ENTRY_POINTS, BUILT_IN, Robot)


def load_robot(name: str) -> Robot:
    """A robot by name.

    Raises:
        UnknownNameError: with the nearest known name.
        UsageError: what a plugin names is no such robot.
    """
    robot = ROBOTS.load(name)
    if robot.name != name:
        raise UsageError(f"{ROBOTS.locations()[name]}, which the entry point {name!r} of {ENTRY_POINTS} names, calls itself {robot.name!r}")
    return robot


def with_robot(tasks: Sequence[TaskSpec], name: str | None = None) -> list[TaskSpec]:
    """The tasks as this robot does them; None: each as the robot of its own file does it.

    Raises:
        UnknownNameError: there is no such robot.
        ContentError: a task's file names a robot that there is not.
    """
    if name is not None:
        load_robot(name)
        return [replace(task, robot=name) for task in tasks]
    for task in tasks:
        try:
            load_robot(task.robot)
        except UnknownNameError as problem:
            raise ContentError(task.file, "robot", str(problem)) from None
    return list(tasks)
