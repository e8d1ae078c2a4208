"""A gymnasium environment as ours: what it wants to be told, and what it says of itself. Imports gymnasium only where it is made."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec, Image
from osel_sim.interface.policy import Actions
from osel_sim.sim.fingerprint import Fingerprint
from osel_sim.suites.base import BaseEnvironment, PlainInstance
from osel_sim.suites.scenes import mujoco_of, of_mujoco, of_numbers

SUCCESS = ("is_success", "success", "succeed")
"""What its `info` calls whether the task is done; the first that is there. The last is gym-hil's, and of what was made after it."""
PIXELS = "pixels"
RENDERED = "render"
"""Name of the camera of an environment that shows pictures by `render()` alone."""
HOLDS = ("zero", "state")


@dataclass(frozen=True, kw_only=True)
class Unsaid:
    """What a gymnasium environment does not say of itself.

    Attributes:
        control_hz: control steps a second; 0: as its metadata say (`render_fps`), else 20.
        horizon: control steps after which an episode ends; 0: as it is registered.
        actions: names of the components of an action; empty: a0, a1 ...
        gripper: name of the component that opens and closes the gripper; holding still keeps it as it is.
        gripper_convention: as `ActionSpec` has it.
        hold: how it holds still: `zero` (actions are changes) or `state` (actions are positions, and the first part of the state is where it is).
        state: keys of its observation that policies see, in order; empty: `agent_pos`, or all that are numbers.
        reset: options for `reset`.
    """

    control_hz: float = 0.0
    horizon: int = 0
    actions: tuple[str, ...] = ()
    gripper: str | None = None
    gripper_convention: str = "closed_positive"
    hold: str = "zero"
    state: tuple[str, ...] = ()
    reset: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class GymSettings(Unsaid):
    """The same of an environment by name.

    Attributes:
        name: in messages, and as the robot.
    """

    name: str


class GymEnvironment(BaseEnvironment):
    """Any gymnasium environment with a box of actions whose info says whether the task is done.

    Args:
        env: as `gymnasium.make` gives it, with `render_mode="rgb_array"` where it has no pictures among its observations.

    Raises:
        UsageError: it has no such info, no pictures, no box of actions, or no horizon; says which.
    """

    def __init__(self, env: Any, settings: GymSettings) -> None:
        self._env, self._settings = env, settings
        observation, info = env.reset(seed=0, **self._options())
        self._observation, self._key = observation, _success_key(settings.name, info, env)
        state = _state(settings, observation)
        cameras = _cameras(settings.name, observation, env)
        specification = EnvironmentSpec(
            name=settings.name,
            control_hz=float(settings.control_hz or env.metadata.get("render_fps") or 20),
            action=_action(settings, env.action_space),
            state={name: int(np.asarray(value).size) for name, value in state.items()},
            cameras=cameras,
            context_camera=cameras[0],
            robot=settings.name,
            horizon=_horizon(settings, env),
        )
        super().__init__(specification, _horizon(settings, env))
        self._fingerprint: tuple[Any, Fingerprint] | None = None
        self._last: Actions | None = None

    def start(self, instance: PlainInstance) -> None:
        """Reset it with the instance's seed."""
        self._observation, _ = self._env.reset(seed=instance.simulator_seed, **self._options())
        self._last = None

    def scene(self) -> str:
        """Digest of MuJoCo's state and of what is observed; of the numbers observed alone, where something else simulates."""
        observed = self._observation if isinstance(self._observation, Mapping) else {"observation": self._observation}
        numbers, found = _leaves(observed), mujoco_of(self._env.unwrapped)
        if found is None:
            return of_numbers(numbers, self.instance)
        model, data = found
        if self._fingerprint is None or self._fingerprint[0] is not model:  # an environment may compile its scene anew
            self._fingerprint = model, Fingerprint(model)
        return of_mujoco(self._fingerprint[1], np.concatenate([data.qpos, *(values for _, values in numbers)]), self.instance)

    def act(self, action: Actions) -> bool:
        """One control step."""
        self._observation, _, _, _, info = self._env.step(action.astype(self._env.action_space.dtype))
        self._last = action
        return bool(info[self._key])

    def state(self) -> Mapping[str, ArrayLike]:
        """The parts of its observation that are numbers."""
        return _state(self._settings, self._observation)

    def render(self, camera: str) -> Image:
        """A picture among its observations, else its `render()`."""
        if camera == RENDERED:
            return np.asarray(self._env.render(), np.uint8)
        pixels = self._observation[PIXELS]
        return np.asarray(pixels[camera] if isinstance(pixels, Mapping) else pixels, np.uint8)

    def hold_action(self) -> Actions:
        """No motion, or the position where it is; the gripper as it was told last."""
        spec = self.specification.action
        hold = spec.clip(np.zeros(spec.dimension))
        if self._settings.hold == "state":
            parts = self.state()
            first: NDArray[np.float64] = np.asarray(parts[next(iter(parts))], np.float64).ravel()
            hold = spec.clip(first[: spec.dimension])
        if spec.gripper_index is not None and self._last is not None:
            hold[spec.gripper_index] = self._last[spec.gripper_index]
        return hold

    def close(self) -> None:
        """Close it."""
        self._env.close()

    def _options(self) -> dict[str, Any]:
        return {"options": dict(self._settings.reset)} if self._settings.reset else {}


def _success_key(name: str, info: Mapping[str, Any], env: Any) -> str:
    """What its info calls success; a step is made where `reset` does not say it."""
    seen = set(info)
    for key in SUCCESS:
        if key in info:
            return key
    space = env.action_space
    if hasattr(space, "low"):
        info = env.step(np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype))[4]
    for key in SUCCESS:
        if key in info:
            return key
    raise UsageError(f"{name}: its info must say {' or '.join(map(repr, SUCCESS))}, it has: {', '.join(sorted({*seen, *info})) or 'nothing'}")


def _cameras(name: str, observation: Any, env: Any) -> tuple[str, ...]:
    pixels = observation.get(PIXELS) if isinstance(observation, Mapping) else None
    if isinstance(pixels, Mapping) and pixels:
        return tuple(pixels)
    if pixels is not None:
        return (PIXELS,)
    if env.render_mode != "rgb_array":
        raise UsageError(f"{name}: it shows no pictures: neither among its observations nor by render_mode 'rgb_array'")
    return (RENDERED,)


def _state(settings: GymSettings, observation: Any) -> dict[str, NDArray[np.float64]]:
    """The parts of an observation that are numbers, each in one row."""
    parts = observation if isinstance(observation, Mapping) else {"observation": observation}
    flat = dict(_leaves(parts))
    names = settings.state or (("agent_pos",) if "agent_pos" in flat else tuple(flat))
    missing = [name for name in names if name not in flat]
    if missing:
        raise UsageError(f"{settings.name}: its observation has no {missing[0]!r}; it has: {', '.join(flat) or 'no numbers'}")
    return {name: flat[name] for name in names}


def _leaves(parts: Mapping[str, Any], prefix: str = "") -> "list[tuple[str, NDArray[np.float64]]]":
    found = []
    for key, value in parts.items():
        if isinstance(value, Mapping):
            found += _leaves(value, f"{prefix}{key}.")
        elif isinstance(value, np.ndarray | np.generic | int | float) and not isinstance(value, bool):
            array = np.asarray(value)
            picture = array.dtype == np.uint8 and array.ndim == 3
            if not picture and array.dtype.kind in "biuf":
                found.append((prefix + key, array.astype(np.float64).ravel()))
    return found


def _action(settings: GymSettings, space: Any) -> ActionSpec:
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None or len(space.shape) != 1:
        raise UsageError(f"{settings.name}: its actions must be a box of one row, they are {space}")
    names = settings.actions or tuple(f"a{index}" for index in range(low.size))
    if len(names) != low.size:
        raise UsageError(f"{settings.name}: actions names {len(names)} components, an action has {low.size}")
    return ActionSpec(names, tuple(map(float, low)), tuple(map(float, high)), settings.gripper, settings.gripper_convention)


def _horizon(settings: GymSettings, env: Any) -> int:
    steps = settings.horizon or (env.spec.max_episode_steps if env.spec is not None else None)
    if not steps:
        steps = getattr(env.unwrapped, "_max_episode_steps", None)
    if not steps:
        raise UsageError(f"{settings.name}: it is registered without an end (max_episode_steps): say horizon in its file")
    return int(steps)


def description(env: GymEnvironment, instruction: str) -> dict[str, Any]:
    """What only the environment knows, as plain data: its specification, and what to do in words where it says that."""
    return {"specification": env.specification.to_dict(), "instruction": instruction}
