"""Tasks of all suites as environments of LeRobot: `lerobot-eval --env.type=osel_sim --env.task=pick_place`.

The package in `plugins/lerobot_env_osel_sim` makes LeRobot import this. Episode i of `lerobot-eval --seed=S` is the instance S + i, the one that
`record --start-seed S` has: the same scene, instruction and horizon, and the same outcome for a policy that executes as many actions of a chunk.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from numpy.typing import NDArray

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.environment import Environment
from osel_sim.interface.suite import Task
from osel_sim.suites.registry import common_specification, select_tasks

LARGEST = 1024
"""Pixels that an image may be wide."""


@EnvConfig.register_subclass("osel_sim")
@dataclass
class OselSimEnv(EnvConfig):  # type: ignore[misc]  # LeRobot is untyped
    """What `--env.type=osel_sim` takes.

    Attributes:
        task: names as `--task` of `record` takes them, separated by commas: `pick_place`, `pick_place,lift`, `tag:short`, `all`, `SUITE:TASK`.
        level, axes: of perturbation.
        split: which instances, as seeds count them.
        cameras: images of an observation; empty: all that the environment has. Each costs time in every step.
        image_size: of them, pixels, square.
        video_size: of the evaluator's videos, pixels, square.
        robot: that does our own tasks; None: each task's own.
        tasks_dir: folder with task files of the user's own.
        fps: control steps a second; the environment's own, whatever is given.
        features, features_map: what LeRobot makes policies from; the environment's own, likewise.

    Raises:
        OselError: no such task, camera, split, level, axis or robot; names the nearest.
    """

    task: str = "pick_place"
    level: int = 0
    axes: dict[str, int] = field(default_factory=dict)
    split: str = "test"
    cameras: list[str] = field(default_factory=list)
    image_size: int = 96
    video_size: int = 256
    robot: str | None = None
    tasks_dir: str | None = None

    def __post_init__(self) -> None:
        tasks = self._tasks()
        specification = common_specification(tasks)
        tasks[0].instance(0, self.level, self.split, self.axes)  # refuses what there is not
        for camera in self.cameras:
            if camera not in specification.cameras:
                raise UnknownNameError("camera", camera, specification.cameras)
        for name in ("image_size", "video_size"):
            if not 1 <= getattr(self, name) <= LARGEST:
                raise UsageError(f"{name} must be an integer in [1, {LARGEST}], got {getattr(self, name)}")
        self.cameras = self.cameras or list(specification.cameras)
        self.fps = round(specification.control_hz)
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (specification.action.dimension,))}
        if specification.state:
            self.features[OBS_STATE] = PolicyFeature(FeatureType.STATE, (specification.state_size,))
        for camera in self.cameras:
            self.features[f"{OBS_IMAGES}.{camera}"] = PolicyFeature(FeatureType.VISUAL, (self.image_size, self.image_size, 3))
        self.features_map = {key: key for key in self.features}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: no environment is made by gymnasium's name for it."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Task -> {0: a vector of `n_envs` environments}. Processes start afresh (`forkserver`), so that they can draw."""
        made: dict[str, dict[int, VectorEnv]] = {}
        for task in self._tasks():
            make = freeze_after_episode_end(partial(self._make, task))
            several: list[Callable[[], Any]] = [make] * n_envs
            if use_async_envs and n_envs > 1:
                made[task.name] = {0: AsyncVectorEnv(several, context="forkserver", autoreset_mode=AutoresetMode.NEXT_STEP)}
            else:
                made[task.name] = {0: SyncVectorEnv(several, autoreset_mode=AutoresetMode.NEXT_STEP)}
        return made

    def _tasks(self) -> list[Task]:
        names = [name.strip() for name in self.task.split(",") if name.strip()]
        return select_tasks(names, None if self.tasks_dir is None else Path(self.tasks_dir), self.robot)

    def _make(self, task: Task) -> "TaskForLeRobot":
        return TaskForLeRobot(task, self)


class TaskForLeRobot(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """One task in the words of LeRobot's evaluator: `pixels`, `agent_pos`, `is_success`, `task_description`.

    The environment is opened by the first `reset`, since LeRobot makes those of all tasks beforehand.
    """

    def __init__(self, task: Task, config: OselSimEnv) -> None:
        specification = task.specification
        self._task, self._config, self._specification = task, config, specification
        self._env: Environment | None = None
        self._max_episode_steps = task.info.horizon
        self.task, self.task_description = task.name, ""
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": config.fps}
        self.render_mode = "rgb_array"
        shape = (config.image_size, config.image_size, 3)
        spaces: dict[str, gymnasium.Space[Any]] = {
            "pixels": gymnasium.spaces.Dict({camera: Box(0, 255, shape, np.uint8) for camera in config.cameras})
        }
        if specification.state:
            spaces["agent_pos"] = Box(-np.inf, np.inf, (specification.state_size,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(spaces)
        low, high = (np.array(bound, np.float32) for bound in (specification.action.low, specification.action.high))
        self.action_space = Box(low, high, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Load the instance of that seed; without one, some instance. LeRobot's own options change nothing."""
        super().reset(seed=seed)
        config = self._config
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        instance = self._task.instance(number, config.level, config.split, config.axes)
        self._env = self._env or self._task.open()
        self._env.load(instance)
        self.task_description = instance.instruction
        return self._observation(self._env), {"is_success": False}

    def step(self, action: NDArray[Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step; the reward is 1 where the task is done."""
        env = self._opened()
        env.advance(self._specification.action.clip(action))
        success = bool(env.success)
        return self._observation(env), float(success), success, env.done and not success, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """A frame of the evaluator's video."""
        size = self._config.video_size
        return self._opened().image(self._specification.context_camera, size, size)

    def close(self) -> None:
        """Close the environment; another `reset` opens it again."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _opened(self) -> Environment:
        if self._env is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._env

    def _observation(self, env: Environment) -> dict[str, Any]:
        shown = env.observe(self._config.cameras, self._config.image_size)
        pixels = {camera: shown[f"{OBS_IMAGES}.{camera}"] for camera in self._config.cameras}
        return {"pixels": pixels, **({"agent_pos": shown[OBS_STATE]} if self._specification.state else {})}
