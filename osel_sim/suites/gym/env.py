"""Environments as `gymnasium.make` gives them: here, or in the suite's host process."""

import contextlib
import dataclasses
from typing import Any

import osel_sim.suites.gym.tasks as files
from osel_sim.core.errors import UsageError, nearest
from osel_sim.interface.environment import Environment
from osel_sim.suites.gymnasium_env import GymEnvironment, GymSettings, Unsaid, description

PLUGINS = ("gymnasium_robotics",)
"""Packages that register environments when they are imported."""


def open_environment(task: str) -> Environment:
    """Make one.

    Args:
        task: what `osel_sim.suites.gym.tasks.GymTask.packed` gave: all that its file says.

    Raises:
        UsageError: gymnasium has no such environment or cannot make it, or it is none for this suite; says why.
    """
    return _make(files.unpacked(task))


def describe(task: str) -> dict[str, Any]:
    """What the environment says of itself."""
    with contextlib.closing(_make(files.unpacked(task))) as env:
        return description(env, "")


def _make(task: "files.GymTask") -> GymEnvironment:
    import gymnasium

    for package in PLUGINS:
        with contextlib.suppress(ImportError):
            gymnasium.register_envs(__import__(package))
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    try:
        env = gymnasium.make(task.id, render_mode="rgb_array", **task.make)
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        near = nearest(task.id, gymnasium.registry)
        raise UsageError(f"gymnasium cannot make {task.id!r} ({str(error).strip()})" + (f"; did you mean {near[0]!r}?" if near else "")) from None
    except TypeError as error:
        raise UsageError(f"gymnasium cannot make {task.id!r} with render_mode 'rgb_array' ({error})") from None
    unsaid = {field.name: getattr(task, field.name) for field in dataclasses.fields(Unsaid)}
    return GymEnvironment(env, GymSettings(f"gym:{task.id}", **unsaid))
