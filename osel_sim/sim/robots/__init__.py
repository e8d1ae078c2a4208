"""Robots by name: one file a robot. Listing them imports none."""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from importlib.metadata import entry_points

from osel_sim.core.errors import ContentError, UnknownNameError, UsageError
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.robot import Robot

ENTRY_POINTS = "osel_sim.robots"
"""Entry-point group in which other packages offer robots: `name = "module:ROBOT"`."""

BUILT_IN = {
    "Kinova3": "osel_sim.sim.robots.kinova3:KINOVA3",
    "Panda": "osel_sim.sim.robots.panda:PANDA",
    "UR5e": "osel_sim.sim.robots.ur5e:UR5E",
}


def robot_locations() -> dict[str, str]:
    """Name -> `module:attribute` of every robot, installed plugins included; a plugin cannot replace a built-in one."""
    return {point.name: point.value for point in entry_points(group=ENTRY_POINTS)} | BUILT_IN


def load_robot(name: str) -> Robot:
    """A robot by name.

    Raises:
        UnknownNameError: with the nearest known name.
        UsageError: what a plugin names is no such robot.
    """
    locations = robot_locations()
    if name not in locations:
        raise UnknownNameError("robot", name, locations)
    module, _, attribute = locations[name].partition(":")
    robot = getattr(import_module(module), attribute)
    if not isinstance(robot, Robot) or robot.name != name:
        raise UsageError(f"{locations[name]}, which the entry point {name!r} of {ENTRY_POINTS} names, must be a Robot of that name, got {robot!r}")
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
