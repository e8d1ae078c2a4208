"""A task as a `gymnasium.Env`, and the calls the episode loop needs beside `reset` and `step`."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.interface.policy import Observation
from osel_sim.interface.specification import ACTION, ACTION_DIM, CONTROL_HZ, STATE_DIM, specification
from osel_sim.sim import predicates
from osel_sim.sim.cameras import LARGEST
from osel_sim.sim.instance import Instance, make_instance
from osel_sim.sim.robots import with_robot
from osel_sim.sim.world import Snapshot, World

if TYPE_CHECKING:
    from osel_sim.sim.expert import Expert

OPTIONS = ("instance", "seed", "level", "split", "axes")
"""What `reset` takes as options."""
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

    Observations of `reset` and `step` are a dictionary of `state` (8,) and, for each camera, `image_CAMERA` (image_size, image_size, 3): names that
    torch takes for a network's parts, as stable-baselines3 does. `observe` has the same under LeRobot's names.

    Args:
        task: a task file's spec, or the name of one.
        split, level, axes: which instances `reset` draws, as `make_instance` takes them.
        cameras: images that `reset` and `step` return; none by default, since an image costs more than a step. `observe` renders on demand.
        image_size: pixels, square.
        render_mode: `rgb_array` or None.
        robot: name of the robot; None: the task's own.

    Raises:
        UsageError: an unknown camera or way of rendering, or an image size out of range.
        OselError: the task, split, level, an axis or the robot is not known; names the nearest.
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
        self.instance: Instance = make_instance(task, 0, level, split, axes)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UnknownNameError("render mode", str(render_mode), self.metadata["render_modes"])
        if not isinstance(image_size, int | np.integer) or not 1 <= image_size <= LARGEST:
            raise UsageError(f"image_size must be an integer in [1, {LARGEST}], got {image_size!r}")
        self.task = task
        self.split, self.level, self.axes = split, level, dict(axes or {})
        self.cameras, self.image_size = (cameras,) if isinstance(cameras, str) else tuple(cameras), int(image_size)
        self.render_mode = render_mode
        self.world = World(task)
        there = [*self.world.scene.cameras, *(self.world.model.camera(index).name for index in range(self.world.model.ncam))]
        for camera in self.cameras:
            if camera not in there:
                raise UnknownNameError("camera", str(camera), there)
        self._images = Cameras(self.world.model, self.world.scene.xml, self.world.appearance)
        self.world.load(self.instance)
        self.steps, self._reached = 0, 0
        spaces: dict[str, gymnasium.Space[Any]] = {"state": gymnasium.spaces.Box(-np.inf, np.inf, (STATE_DIM,), np.float32)}
        for camera in self.cameras:
            spaces[f"image_{camera}"] = gymnasium.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)
        self.observation_space = gymnasium.spaces.Dict(spaces)  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Load an instance.

        Args:
            seed: of the random numbers that instances are drawn by, as gymnasium has it.
            options: for this episode. `instance`: that `Instance` of the task. Or any of `seed` (of the instance itself, as in its key; else it is
                drawn), `level`, `split` and `axes`, each in place of the environment's own.

        Raises:
            UsageError: an unknown option, or a value that none can have.
        """
        super().reset(seed=seed)
        self.load(self._chosen(options or {}))
        return self._gym_observation(), self._info()

    def step(self, action: NDArray[Any]) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """One control step; ends with success, or at the horizon. Actions beyond [-1, 1] are clipped.

        Raises:
            UsageError: not 7 finite real numbers.
        """
        self.advance(self._checked(action))
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

    def scene_digest(self) -> str:
        """Digest of the loaded instance's scene, as it was set up."""
        return self.world.scene_digest()

    def snapshot(self) -> EnvSnapshot:
        """The state now; `restore` goes on from it to the same bits."""
        return EnvSnapshot(self.world.snapshot(), self.steps, self._reached)

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Back to a snapshot, of this environment or of another one of the same task."""
        self.world.restore(snapshot.world)
        self.instance = snapshot.world.instance
        self.steps, self._reached = snapshot.steps, snapshot.reached

    # -- inside --------------------------------------------------------------------------------------------------------

    def _chosen(self, options: Mapping[str, Any]) -> Instance:
        """The instance that `reset` is asked for."""
        for name in options:
            if name not in OPTIONS:
                raise UnknownNameError("option of reset", str(name), OPTIONS)
        instance = options.get("instance")
        if instance is not None:
            if others := [name for name in options if name != "instance"]:
                raise UsageError(f"options: an instance has its own {', '.join(others)}; give one or the other")
            if not isinstance(instance, Instance) or (instance.task, instance.robot) != (self.task.name, self.task.robot):
                raise UsageError(f"options: instance must be one of {self.task.name!r} with {self.task.robot}, as make_instance makes it")
            return instance
        seed = options.get("seed")
        number = int(self.np_random.integers(2**31)) if seed is None else _integer("seed", seed)
        level = _integer("level", options.get("level", self.level))
        axes = options.get("axes", self.axes)
        if not isinstance(axes, Mapping):
            raise UsageError(f"options: axes must be a mapping from axis to level, got {axes!r}")
        return make_instance(self.task, number, level, options.get("split", self.split), axes)

    def _checked(self, action: Any) -> NDArray[np.float64]:
        """An action of a user as numbers within the bounds."""
        try:
            values = np.asarray(action)
        except ValueError:  # ragged lists
            values = np.empty(0, object)
        if values.dtype.kind not in "fiu" or values.shape != (ACTION_DIM,):
            raise UsageError(f"an action must be {ACTION_DIM} real numbers of shape ({ACTION_DIM},), got {values.dtype} of shape {values.shape}")
        if not np.isfinite(values).all():
            raise UsageError(f"an action must be finite numbers, got {values.tolist()}")
        return np.clip(values.astype(np.float64), ACTION.low, ACTION.high)

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
        size = self.image_size
        return {"state": self._state(), **{f"image_{camera}": self.image(camera, size, size) for camera in self.cameras}}

    def _info(self) -> dict[str, Any]:
        return {"instruction": self.instance.instruction, "instance": self.instance.key, "success": self.success, "subgoals": self.subgoal_fraction}


def _integer(name: str, value: Any) -> int:
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None:
        raise UsageError(f"options: {name} must be an integer, got {value!r}")
    return number
