"""Tasks of all suites as a benchmark of vla-evaluation-harness (package vla-eval 0.8): `benchmark: osel_sim.suites.vla_eval_benchmark:OselSim`.

Episode i of a task is the instance seed + i, the one that `record --start-seed SEED` has.
"""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.render import configure_mujoco_render
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, RAW, ROTATION_AA, STATE_EEF_POS_AA_GRIP

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.instance import OURS
from osel_sim.suites.open_tasks import OpenTasks
from osel_sim.suites.registry import common_specification, select_tasks


class OselSim(StepBenchmark):  # type: ignore[misc]  # vla-eval is no dependency
    """What `params` of a benchmark's entry takes.

    Args:
        tasks: names as `--task` of `record` takes them, separated by commas.
        seed: of the instance of the first episode.
        level, axes: of perturbation.
        split: which instances, as seeds count them.
        cameras: images of an observation; None: all that the environment has.
        image_size: of them, pixels, square.
        robot: that does our own tasks; None: each task's own.
        tasks_dir: folder with task files of the user's own.

    Raises:
        OselError: no such task, camera, split, level, axis or robot; names the nearest.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    def __init__(
        self,
        tasks: str = "pick_place",
        seed: int = 0,
        level: int = 0,
        axes: dict[str, int] | None = None,
        split: str = "test",
        cameras: list[str] | None = None,
        image_size: int = 256,
        robot: str | None = None,
        tasks_dir: str | None = None,
    ) -> None:
        super().__init__()
        names = [name.strip() for name in tasks.split(",") if name.strip()]
        self._tasks = {task.name: task for task in select_tasks(names, None if tasks_dir is None else Path(tasks_dir), robot)}
        self._specification = common_specification(self._tasks.values())
        self._seed, self._level, self._split, self._axes = seed, level, split, dict(axes or {})
        for task in self._tasks.values():
            task.instance(seed, level, split, self._axes)  # refuses what there is not
        self._cameras, self._size = list(cameras or self._specification.cameras), image_size
        for camera in self._cameras:
            if camera not in self._specification.cameras:
                raise UnknownNameError("camera", camera, self._specification.cameras)
        self._open = OpenTasks(self._tasks.values(), keep=1)  # their episodes come task by task
        self._env: Any = None

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """`gpu` leaves the choice to us: EGL, or OSMesa where that does not work."""
        return configure_mujoco_render(mode) if mode == "cpu" else {}

    def get_tasks(self) -> list[dict[str, Any]]:
        """A task of theirs for each of ours."""
        return [{"name": name, "suite": task.suite.spec.name} for name, task in self._tasks.items()]

    def reset(self, task: dict[str, Any]) -> Any:
        """Load the instance of an episode."""
        name = task["name"]
        self._env = self._open[name]
        self._env.load(self._tasks[name].instance(self._seed + task["episode_idx"], self._level, self._split, self._axes))
        return self._env.observe(self._cameras, self._size)

    def step(self, action: dict[str, Any]) -> StepResult:
        """One control step.

        Raises:
            UsageError: it is not one action of as many finite numbers as the environment takes.
        """
        spec, given = self._specification.action, np.asarray(action.get("actions"))
        if given.dtype.kind not in "fiu" or given.shape != (spec.dimension,) or not np.isfinite(given).all():
            raise UsageError(
                f"one action of {spec.dimension} finite numbers is needed, got {given.dtype} of shape {given.shape}; "
                "a model server whose model makes chunks needs chunk_size"
            )
        self._env.advance(spec.clip(given))
        done = self._env.done
        seen = None if done else self._env.observe(self._cameras, self._size)
        return StepResult(obs=seen, reward=float(self._env.success), done=done, info={})

    def make_obs(self, raw_obs: Any, task: dict[str, Any]) -> dict[str, Any]:
        """An observation in their words."""
        images = {camera: raw_obs[f"observation.images.{camera}"] for camera in self._cameras}
        state = {"states": raw_obs["observation.state"]} if self._specification.state else {}
        return {"images": images, "task_description": raw_obs["task"], **state}

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """What the episode came to."""
        return {"success": bool(self._env.success), "subgoals": float(self._env.subgoal_fraction)}

    def get_metric_keys(self) -> dict[str, str]:
        """Both are averaged."""
        return {"success": "mean", "subgoals": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        """The longest horizon; shorter ones end their episodes themselves."""
        return {"max_steps": max(task.info.horizon for task in self._tasks.values())}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """What holds the robot still."""
        return {"actions": self._env.hold_action()} if self._env else {"actions": np.zeros(self._specification.action.dimension, np.float32)}

    def get_action_spec(self) -> dict[str, Any]:
        """Our own robots' actions; of other suites' nothing is said."""
        ours = all(task.suite.spec.name == OURS for task in self._tasks.values())
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS} if ours else {"actions": RAW}

    def get_observation_spec(self) -> dict[str, Any]:
        """Images, state and instruction."""
        ours = all(task.suite.spec.name == OURS for task in self._tasks.values())
        state = {"state": STATE_EEF_POS_AA_GRIP if ours else RAW} if self._specification.state else {}
        return {"image": IMAGE_RGB, "language": LANGUAGE, **state}

    def cleanup(self) -> None:
        """Close the environment."""
        self._open.close()
