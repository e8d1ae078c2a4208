"""Environments as LeRobot makes them. Imported where LeRobot is installed: here, or in the suite's host process."""

import contextlib
import sys
from typing import Any

import numpy as np

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.environment import Environment, Image
from osel_sim.suites.gymnasium_env import GymEnvironment, GymSettings, description

POSITIONS = ("aloha", "pusht")
"""Types whose actions are positions: holding still is to be told where one is."""
GRIPPERS = {"libero": ("a6", "closed_positive"), "libero_plus": ("a6", "closed_positive"), "so101": ("a3", "open_positive")}
"""Type -> the component of an action that is the gripper's, and its convention."""


def open_environment(task: str) -> Environment:
    """Make one: `TYPE`, `TYPE/TASK`, or `TYPE/TASK/NUMBER` where a type has numbered tasks, such as `libero_10/3`.

    Raises:
        UnknownNameError: LeRobot has no such type.
        UsageError: it cannot make the environment; says why.
    """
    return _make(task)[0]


def describe(task: str) -> dict[str, Any]:
    """What LeRobot says of a task: specification, and its description in words, empty where it gives none."""
    env, words = _make(task)
    with contextlib.closing(env):
        return description(env, words)


def split(task: str) -> tuple[str, str, int | None]:
    """Type, task and number of a name: `libero_10/3` is the third of libero's suite `libero_10`."""
    head, _, rest = task.partition("/")
    if head.startswith("libero_") and head != "libero_plus":
        head, rest = "libero", task
    name, _, number = rest.rpartition("/") if rest.rpartition("/")[2].isdecimal() else (rest, "", "")
    if not name and number:
        name, number = number, ""
    return head, name, int(number) if number else None


def _make(task: str) -> tuple[GymEnvironment, str]:
    from lerobot.envs.configs import EnvConfig
    from lerobot.envs.factory import make_env, make_env_config
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    kind, name, number = split(task)
    known = sorted(EnvConfig.get_known_choices())
    if kind not in known:
        raise UnknownNameError("environment type of LeRobot", kind, known)
    given: dict[str, Any] = {"task": name} if name else {}
    if number is not None:
        given["task_ids"] = [number]
    try:
        with contextlib.redirect_stdout(sys.stderr):
            config = make_env_config(kind, **given)
            made = make_env(config, n_envs=1)
    except ModuleNotFoundError:
        raise
    except Exception as error:
        raise UsageError(f"LeRobot cannot make {task!r} ({type(error).__name__}: {' '.join(str(error).split())[:300]})") from error
    vectors = [vector for tasks in made.values() for vector in tasks.values()]
    if len(vectors) != 1:
        raise UsageError(f"{task!r} names {len(vectors)} environments of LeRobot: add its number, as in {task}/0")
    env = vectors[0].envs[0]
    settings = GymSettings(
        name=f"lerobot:{task}",
        control_hz=float(config.fps),
        horizon=int(getattr(config, "episode_length", 0) or 0),
        gripper=GRIPPERS[kind][0] if kind in GRIPPERS else None,
        gripper_convention=GRIPPERS[kind][1] if kind in GRIPPERS else "closed_positive",
        hold="state" if kind in POSITIONS else "zero",
    )
    words = getattr(env.unwrapped, "task_description", "")
    made_of = AlohaEnvironment if kind == "aloha" else GymEnvironment
    return made_of(env, settings), words if isinstance(words, str) else ""


class AlohaEnvironment(GymEnvironment):
    """gym-aloha draws three large pictures at every step; here one is drawn when it is asked for."""

    def __init__(self, env: Any, settings: GymSettings) -> None:
        physics = env.unwrapped._env.physics
        self._draw = physics.render
        self._size = (env.unwrapped.observation_height, env.unwrapped.observation_width)
        blank = np.zeros((*self._size, 3), np.uint8)
        physics.render = lambda *arguments, **named: blank
        super().__init__(env, settings)

    def render(self, camera: str) -> Image:
        """A picture of the size that LeRobot asks for."""
        return np.asarray(self._draw(height=self._size[0], width=self._size[1], camera_id=camera), np.uint8)
