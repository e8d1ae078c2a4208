"""A task as a `gymnasium.Env`, and the calls the episode loop needs beside `reset` and `step`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Observation
from osel_sim.sim import predicates
from osel_sim.sim.instance import Instance, make_instance
from osel_sim.sim.robots import with_robot
from osel_sim.sim.specification import ACTION_DIM, CONTROL_HZ, STATE_DIM, specification
from osel_sim.sim.world import Snapshot, World

if TYPE_CHECKING:
    from osel_sim.sim.expert import Expert

WAITING = 0.0
"""A gripper command of 0 leaves the fingers as they are (only the sign counts)."""


@dataclass(frozen=True)
class EnvSnapshot:
    """State of an environment in the middle of an episode."""

    world: Snapshot
    steps: int
    reached: int


class TaskEnv(gymnasium.Env[dict[str, NDArray[Any]], NDArray[np.float32]]):
    """One task. Actions are 7-d OSC_POSE deltas in [-1, 1] at 20 Hz; the reward is 1 on the step that fulfils the goal.

    Args:
        task: a task file's spec, or the name of one.
        split, level, axes: which instances `reset` draws, as `make_instance` takes them.
        cameras: images that `reset` and `step` return; none by default, since an image costs more than a step. `observe` renders on demand.
        image_size: pixels, square.
        render_mode: `rgb_array` or None.
        robot: name of the robot; None: the task's own.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012 (gymnasium's own declaration)

    def __init__(
        self,
        task: TaskSpec | str,
        *,
        split: str = "train",
        level: int = 0,
        axes: Mapping[str, int] | None = None,
        cameras: Sequence[str] = (),
        image_size: int = 96,
        render_mode: str | None = None,
        robot: str | None = None,
    ) -> None:
        from osel_sim.sim.gl import choose_backend

        choose_backend()  # before robosuite is imported: it forces EGL otherwise
        if isinstance(task, str):
            from osel_sim.core import content

            task = load_task_file(content.find("tasks", task))
        from osel_sim.sim.cameras import Cameras

        task = with_robot([task], robot)[0]
        self.task = task
        self.split, self.level, self.axes = split, level, dict(axes or {})
        self.cameras, self.image_size = tuple(cameras), image_size
        self.render_mode = render_mode
        self.world = World(task)
        self._images = Cameras(self.world.model, self.world.scene.xml, self.world.appearance)
        self.instance: Instance = make_instance(task, 0, level, split, axes)
        self.world.load(self.instance)
        self.steps, self._reached = 0, 0
        spaces: dict[str, gymnasium.Space[Any]] = {"observation.state": gymnasium.spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32)}
        for camera in self.cameras:
            spaces[f"observation.images.{camera}"] = gymnasium.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Load a random instance, or `options={"instance": Instance}`."""
        super().reset(seed=seed)
        instance = (options or {}).get("instance")
        if instance is None:
            instance = make_instance(self.task, int(self.np_random.integers(2**31)), self.level, self.split, self.axes)
        self.load(instance)
        return self._gym_observation(), self._info()

    def step(self, action: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """One control step; ends with success, or at the horizon."""
        self.advance(action)
        success = self.success
        return self._gym_observation(), float(success), success, not success and self.steps >= self.task.horizon, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """A full-quality image, with `render_mode="rgb_array"`."""
        return self.image("agentview", 480, 480, "full") if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Give the GL contexts back."""
        self._images.close()

    # -- osel_sim.interface.environment: what the episode loop uses ----------------------------------------------------

    @property
    def specification(self) -> EnvironmentSpec:
        """What it offers a policy."""
        return specification(self.task.robot, self.task.horizon)

    def load(self, instance: Instance) -> None:
        """Reset to an instance."""
        self.instance = instance
        self.world.load(instance)
        self.steps, self._reached = 0, 0
        self._advance_subgoals()

    def advance(self, action: NDArray[Any]) -> None:
        """One control step, without an observation."""
        self.world.step(action)
        self.steps += 1
        self._advance_subgoals()

    def observe(self, cameras: Sequence[str], size: int) -> Observation:
        """What a policy is shown now, rendered now (see `osel_sim.interface.policy.Observation`)."""
        observation: Observation = {f"observation.images.{camera}": self.image(camera, size, size) for camera in cameras}
        observation["observation.state"] = self._state()
        observation["task"] = self.instance.instruction
        return observation

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> NDArray[np.uint8]:
        """Image (height, width, 3) of `agentview` or `wrist`; quality `fast` or `full`."""
        return self._images.render(self.world.data, camera, width, height, quality)

    def hold_action(self) -> NDArray[np.float32]:
        """The action that holds still, fingers as they are."""
        action = np.zeros(ACTION_DIM, dtype=np.float32)
        action[-1] = WAITING
        return action

    @property
    def success(self) -> bool:
        """Every goal predicate holds now."""
        return all(predicates.holds(self.world, term) for term in self.task.goal)

    @property
    def subgoal_fraction(self) -> float:
        """Share of the subgoals reached so far, in their order."""
        return self._reached / len(self.task.subgoals) if self.task.subgoals else 0.0

    @property
    def done(self) -> bool:
        """Success, or the horizon is reached."""
        return self.steps >= self.task.horizon or self.success

    def expert(self) -> "Expert":
        """The scripted expert, at the beginning of its plan for the loaded instance."""
        from osel_sim.sim.expert import Expert

        return Expert(self.world)

    def entity_positions(self) -> dict[str, NDArray[np.float64]]:
        """World position (3,) of everything in the scene, of its handle where it has one: labels for training, never shown to a policy."""
        return {placement.entity: self.world.landmark(placement.entity).copy() for placement in self.instance.placements}

    def project(self, points: NDArray[np.float64], camera: str, size: int) -> NDArray[np.float64]:
        """Pixel (x, y) of world points (N, 3) in a square image of a camera -> (N, 2)."""
        from osel_sim.sim.cameras import project

        return project(self.world.model, self.world.data, points, self._camera(camera), size)

    def snapshot(self) -> EnvSnapshot:
        """The state now; `restore` goes on from it to the same bits."""
        return EnvSnapshot(self.world.snapshot(), self.steps, self._reached)

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Back to a snapshot, of this environment or of another one of the same task."""
        self.world.restore(snapshot.world)
        self.instance = snapshot.world.instance
        self.steps, self._reached = snapshot.steps, snapshot.reached

    # -- inside --------------------------------------------------------------------------------------------------------

    def _advance_subgoals(self) -> None:
        subgoals = self.task.subgoals
        while self._reached < len(subgoals) and predicates.holds(self.world, subgoals[self._reached][1]):
            self._reached += 1

    def _camera(self, camera: str) -> int:
        """Index of a camera in the model."""
        return int(self.world.model.camera(self.world.scene.cameras.get(camera, camera)).id)

    def _state(self) -> NDArray[np.float32]:
        world = self.world
        return np.concatenate([world.grip_position, world.grip_rotation_vector(), world.finger_positions]).astype(np.float32)

    def _gym_observation(self) -> dict[str, NDArray[Any]]:
        observation = self.observe(self.cameras, self.image_size)
        return {key: value for key, value in observation.items() if key != "task"}

    def _info(self) -> dict[str, Any]:
        return {"instruction": self.instance.instruction, "instance": self.instance.key, "success": self.success, "subgoals": self.subgoal_fraction}
