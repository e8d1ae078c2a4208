"""A task of Meta-World as an environment. Imported where metaworld is installed: here, or in the suite's host process."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.interface.environment import Image
from osel_sim.interface.policy import Actions
from osel_sim.sim.fingerprint import Fingerprint
from osel_sim.sim.turning import nudged, shifted, turned_light
from osel_sim.suites.base import BaseEnvironment, PlainInstance
from osel_sim.suites.metaworld.tasks import HORIZON, SPECIFICATION, TABLE_TOPS, load_tasks
from osel_sim.suites.mujoco_view import MujocoView
from osel_sim.suites.scenes import of_mujoco

UPSIDE_DOWN = ("corner", "corner2", "corner3")
"""Cameras that hang upside down; LeRobot turns the picture of `corner2`, too."""
CORNER2 = (0.75, 0.075, 0.7)
"""Where LeRobot puts that camera: nearer than it stands in the model."""
PIVOT = np.array([0.0, 0.65, 0.1])
"""What cameras are turned about: the middle of the table, metres."""
SIGNALS = {"near": ("near_object", 1.0), "grasp": ("grasp_success", 1.0), "place": ("in_place_reward", 0.5)}
"""Subgoal -> the environment's own signal, and from where on it counts as reached."""
LANDMARKS = {"object": slice(4, 7), "goal": slice(36, 39), "other": slice(11, 14)}
"""Where they are among the 39 numbers that its experts see."""


class MetaworldEnvironment(BaseEnvironment):
    """One of the 50 tasks, of any of its instances.

    Args:
        task: such as `drawer-open-v3`.
    """

    def __init__(self, task: str) -> None:
        from metaworld.env_dict import ENV_CLS_MAP

        super().__init__(SPECIFICATION, HORIZON)
        self._task, self._subgoals = task, load_tasks()[task].subgoals
        self._env: Any = ENV_CLS_MAP[task]()
        # What its own benchmarks set: initial states drawn from a seed, and the goal among what the scripted expert sees.
        self._env._set_task_called, self._env._freeze_rand_vec, self._env.seeded_rand_vec = True, False, True
        self._env._partially_observable = False
        self._env.__dict__.pop("sawyer_observation_space", None)  # cached before the goal was among it
        model = self._env.model
        self._clean = {name: getattr(model, name).copy() for name in ("body_pos", "body_quat", "site_pos", "site_quat")}
        self._space, self._attributes = self._env._random_reset_space, _plain_attributes(self._env)
        self._observation = np.zeros(39)
        self._reached: set[str] = set()
        self._view = MujocoView(model, self._env.data, self._describe, UPSIDE_DOWN)
        self._fingerprint = Fingerprint(model)

    def start(self, instance: PlainInstance) -> None:
        """Reset to an instance, as if nothing had been before."""
        env = self._env
        for name, clean in self._clean.items():
            getattr(env.model, name)[:] = clean
        mujoco.mj_resetData(env.model, env.data)
        for name, value in _copied(self._attributes).items():
            setattr(env, name, value)
        margin = float(instance.details.get("wider", 0.0)) * (self._space.high - self._space.low)
        env._random_reset_space = type(self._space)(self._space.low - margin, self._space.high + margin, dtype=np.float64)
        env.seed(instance.simulator_seed)
        self._observation = env.reset()[0]
        self._reached = set()
        self._view.dress(lambda model: _dress(model, instance.details))

    def scene(self) -> str:
        """Digest of where everything is, the goal included, and of how it looks."""
        return of_mujoco(self._fingerprint, np.append(self._env.data.qpos, self._env._target_pos), self.instance)

    def act(self, action: Actions) -> bool:
        """One control step."""
        self._observation, _, _, _, signals = self._env.step(action)
        self._reached |= {name for name in self._subgoals if float(signals[SIGNALS[name][0]]) >= SIGNALS[name][1]}
        done = bool(signals["success"])
        if done:
            self._reached |= {*self._subgoals, "success"}
        return done

    @property
    def subgoal_fraction(self) -> float:
        """Share of the task's own signals seen so far, success the last of them."""
        return len(self._reached) / (len(self._subgoals) + 1)

    def state(self) -> Mapping[str, ArrayLike]:
        """The hand's position, metres, and how far the fingers are open, from 0 to 1."""
        return {"position": self._observation[:3], "gripper": self._observation[3:4]}

    def hold_action(self) -> Actions:
        """No motion; the gripper's force stays as it is."""
        return SPECIFICATION.action.clip(np.array([0.0, 0.0, 0.0, self._env.data.ctrl[0]]))

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of a camera; `full` has shadows and multisampling, as stock pictures have."""
        return self._view.render(camera, width, height, quality)

    def render(self, camera: str) -> Image:
        """Image of a camera in the stock size."""
        return self.image(camera, 480, 480)

    def snapshot(self) -> dict[str, Any]:
        """The state now, as plain data."""
        env = self._env
        state = np.empty(mujoco.mj_stateSize(env.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(env.model, env.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        counts = {"steps": self.steps, "success": self.success, "reached": sorted(self._reached)}
        world = {name: getattr(env.model, name).copy() for name in self._clean}
        space = env._random_reset_space
        attributes = _plain_attributes(env)
        instance = {"task": self.instance.task, "seed": self.instance.seed, "split": self.instance.split, "instruction": self.instance.instruction}
        details = {"details": dict(self.instance.details), "level": self.instance.level, "axes": self.instance.axes}
        return {
            **counts,
            "instance": {**instance, **details},
            "state": state,
            "world": world,
            "space": [space.low.copy(), space.high.copy()],
            "observation": self._observation.copy(),
            "attributes": attributes,
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Back to a snapshot of this task; what follows is the same to the last bit."""
        env = self._env
        if self.instance is None or self.instance.key != PlainInstance(**snapshot["instance"]).key:
            self.load(PlainInstance(**snapshot["instance"]))
        for name, value in snapshot["world"].items():
            getattr(env.model, name)[:] = value
        for name, value in _copied(snapshot["attributes"]).items():
            setattr(env, name, value)
        for _ in range(2):  # forward fills in what follows from the state, and begins the next step's solver with what it found: set again
            mujoco.mj_setState(env.model, env.data, snapshot["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(env.model, env.data)
        mujoco.mj_setState(env.model, env.data, snapshot["state"], mujoco.mjtState.mjSTATE_INTEGRATION)
        self._observation = np.array(snapshot["observation"])
        self.steps, self.success, self._reached = snapshot["steps"], snapshot["success"], set(snapshot["reached"])

    def expert(self) -> "MetaworldExpert":
        """Meta-World's scripted expert of this task."""
        from metaworld.policies import ENV_POLICY_MAP

        return MetaworldExpert(ENV_POLICY_MAP[self._task](), self)

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """What Meta-World's own observation tells of."""
        return tuple(LANDMARKS)

    def landmarks(self, cameras: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Where its objects and the goal are; NaN where a task has none."""
        positions = np.stack([self._observation[place] for place in LANDMARKS.values()])
        positions[~positions.any(axis=1)] = np.nan  # what is not there has zeros
        return {"positions": positions, **{camera: self._view.places(camera, positions) for camera in cameras}}

    def seen_by_expert(self) -> NDArray[np.float64]:
        """The simulator's own observation (39,), goal included."""
        return self._observation

    def close(self) -> None:
        """Give the GL contexts back."""
        self._view.close()

    def _describe(self) -> Any:
        spec = mujoco.MjSpec.from_file(self._env.fullpath)
        folder = Path(self._env.fullpath).parents[1] / "textures"
        for name in sorted({top for tops in TABLE_TOPS.values() for top in tops}):
            spec.add_texture(name=f"top_{name}", type=mujoco.mjtTexture.mjTEXTURE_CUBE, file=str(folder / f"{name}.png"))
            material = spec.add_material(name=f"top_{name}")
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"top_{name}"
        camera = spec.camera("corner2")
        camera.pos = CORNER2
        return spec


class MetaworldExpert:
    """Meta-World's own scripted policy, which sees the state."""

    def __init__(self, policy: Any, env: MetaworldEnvironment) -> None:
        self._policy, self._env = policy, env

    def act(self) -> NDArray[np.float64]:
        """The next action (4,) in [-1, 1]."""
        return np.clip(np.asarray(self._policy.get_action(self._env.seen_by_expert()), np.float64), -1.0, 1.0)


def open_environment(task: str) -> MetaworldEnvironment:
    """Make the environment of a task."""
    return MetaworldEnvironment(task)


def _plain_attributes(env: Any) -> dict[str, Any]:
    """What the simulator remembers beside MuJoCo's state: numbers and arrays of its own, not views of MuJoCo's."""
    found = {}
    for name, value in vars(env).items():
        if name in ("model", "data", "width", "height") or name.startswith("__"):
            continue
        own_array = isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and _own(value)
        if own_array or isinstance(value, bool | int | float | np.generic | None):
            found[name] = value
    return _copied(found)


def _own(array: NDArray[Any]) -> bool:
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base is None


def _copied(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in attributes.items()}


def _dress(model: Any, details: Mapping[str, Any]) -> None:
    """How an instance looks, onto a model that looks clean."""
    if "light" in details:
        light = SimpleNamespace(**details["light"])
        model.light_diffuse[:] *= light.lamp
        for index in range(model.nlight):
            model.light_dir[index] = turned_light(model.light_dir[index].copy(), light.lamp_turn)
        model.vis.headlight.ambient[:] *= light.ambient
        model.vis.headlight.diffuse[:] *= light.lamp
    if "camera" in details:
        shift, wrist = SimpleNamespace(**details["camera"]["camera"]), details["camera"]["wrist"]
        for index in range(model.ncam):
            position, quaternion = model.cam_pos[index].copy(), model.cam_quat[index].copy()
            carried = bool(model.cam_bodyid[index])
            pose = nudged(position, quaternion, wrist) if carried else shifted(position, quaternion, shift, PIVOT)
            model.cam_pos[index], model.cam_quat[index] = pose
            model.cam_fovy[index] += 0.0 if carried else shift.fovy
    if "texture" in details:
        top = model.material(f"top_{details['texture']['table']}").id
        model.geom_matid[model.geom_matid == model.material("table_wood").id] = top
        model.mat_rgba[top, :3] *= details["texture"]["tint"]
