"""What an environment is: one task of a suite, made. Its specification says what policies see and how they act."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.policy import Actions, Observation

Image = NDArray[np.uint8]

GRIPPERS = ("closed_positive", "open_positive")
"""Sign of the gripper's component that closes it: `closed_positive` (robosuite, LIBERO) or `open_positive`."""


@dataclass(frozen=True)
class ActionSpec:
    """What one action (D,) holds.

    Attributes:
        names: of the components, such as x, y, z, roll, pitch, yaw, gripper.
        low, high: (D,) bounds of the components; actions of policies are clipped to them.
        gripper: name of the component that opens and closes the gripper; None: there is none. All others are motions.
        gripper_convention: one of `GRIPPERS`.
        turns: names of the motions that rotate; the others move.
        rotation: how the turns are to be read (`axis_angle`, `euler`, ...); empty where there are none.
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    gripper: str | None = None
    gripper_convention: str = "closed_positive"
    turns: tuple[str, ...] = ()
    rotation: str = ""

    def __post_init__(self) -> None:
        named = [*self.turns, *([] if self.gripper is None else [self.gripper])]
        if not self.names or not len(self.names) == len(self.low) == len(self.high):
            raise UsageError(f"an action needs a name, a low and a high bound for each component, got {self.names}, {self.low}, {self.high}")
        if len(set(self.names)) < len(self.names) or not set(named) <= set(self.names):
            raise UsageError(f"components of an action must be different and include gripper and turns ({', '.join(named)}), got {self.names}")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise UsageError(f"each low bound of an action must be below its high bound, got {self.low} and {self.high}")
        if self.gripper_convention not in GRIPPERS:
            raise UsageError(f"unknown gripper convention {self.gripper_convention!r}, known: {', '.join(GRIPPERS)}")

    @property
    def dimension(self) -> int:
        """Number of components D."""
        return len(self.names)

    @property
    def motions(self) -> list[int]:
        """Indices of all components but the gripper's; noise goes on these."""
        return [index for index, name in enumerate(self.names) if name != self.gripper]

    @property
    def moves(self) -> list[int]:
        """Indices of the motions that do not turn."""
        return [index for index in self.motions if self.names[index] not in self.turns]

    @property
    def gripper_index(self) -> int | None:
        """Index of the gripper's component."""
        return None if self.gripper is None else self.names.index(self.gripper)

    def clip(self, actions: NDArray[Any]) -> Actions:
        """Actions (..., D) within the bounds, as float32."""
        clipped: Actions = np.clip(actions, self.low, self.high).astype(np.float32)
        return clipped

    @property
    def middle(self) -> NDArray[np.float64]:
        """Middle of the range of each component (D,); 0 where a bound is infinite."""
        return np.array([(low + high) / 2 if np.isfinite(high - low) else 0.0 for low, high in zip(self.low, self.high, strict=True)])

    @property
    def half_range(self) -> NDArray[np.float64]:
        """Half the range of each component (D,): 1 for [-1, 1], and where a bound is infinite."""
        return np.array([(high - low) / 2 if np.isfinite(high - low) else 1.0 for low, high in zip(self.low, self.high, strict=True)])


@dataclass(frozen=True)
class EnvironmentSpec:
    """What an environment offers a policy.

    Attributes:
        name: of the environment, in messages.
        control_hz: control steps a second, on the virtual clock.
        state: name of each part of `observation.state`, in order -> how many numbers it has; empty: there is no state.
        cameras: names of the cameras.
        context_camera: the one that encoders, videos and pages are shown.
        robot: name of the robot.
        horizon: control steps after which an episode ends, where the environment itself fixes it.
        snapshots: whether `snapshot` and `restore` work; where not, an instance is loaded again.
        expert: whether it has a scripted expert (`HasExpert`).
    """

    name: str = field(compare=False)
    control_hz: float
    action: ActionSpec
    state: Mapping[str, int]
    cameras: tuple[str, ...]
    context_camera: str
    robot: str = field(default="", compare=False)
    horizon: int | None = field(default=None, compare=False)
    snapshots: bool = field(default=False, compare=False)
    expert: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        if not self.control_hz > 0:
            raise UsageError(f"{self.name}: control_hz must be positive, got {self.control_hz}")
        if self.context_camera not in self.cameras:
            known = ", ".join(self.cameras) or "none"
            raise UsageError(f"{self.name}: context_camera must be one of its cameras ({known}), got {self.context_camera!r}")

    @property
    def state_size(self) -> int:
        """How many numbers `observation.state` has."""
        return sum(self.state.values())

    def drives_like(self, other: "EnvironmentSpec") -> bool:
        """Whether what was loaded for this environment can drive the other: the same actions, rate, cameras and state, in the same order."""
        return self == other and list(self.state) == list(other.state)

    def to_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "EnvironmentSpec":
        """What `to_dict` gave, also after JSON.

        Raises:
            UsageError: it is nothing of the kind.
        """
        try:
            action: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data["action"].items()}
            return cls(**{**data, "action": ActionSpec(**action), "cameras": tuple(data["cameras"])})
        except (AttributeError, KeyError, TypeError) as error:
            raise UsageError(f"not the specification of an environment ({type(error).__name__}: {error})") from None


class Environment(Protocol):
    """One task of a suite, made: load an instance, observe, step, say when it is done."""

    @property
    def specification(self) -> EnvironmentSpec:
        """What it offers a policy."""
        ...

    @property
    def steps(self) -> int:
        """Control steps since the instance was loaded."""
        ...

    @property
    def success(self) -> bool:
        """Whether the task is done now."""
        ...

    @property
    def subgoal_fraction(self) -> float:
        """Share of the task's subgoals reached so far, in [0, 1]."""
        ...

    @property
    def done(self) -> bool:
        """Whether the episode is over: success, or the horizon is reached."""
        ...

    def load(self, instance: Any) -> None:
        """Reset to an instance of its own suite; the same instance gives the same bits."""
        ...

    def observe(self, cameras: Sequence[str], size: int) -> Observation:
        """What a policy is shown now (`osel_sim.interface.policy.Observation`).

        Args:
            cameras: which images.
            size: of them, pixels, square.
        """
        ...

    def advance(self, action: NDArray[Any]) -> None:
        """One control step with an action (D,)."""
        ...

    def hold_action(self) -> Actions:
        """The action (D,) that holds still, gripper as it is: what the robot does while it waits for an answer."""
        ...

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) RGB of a camera, for encoders and videos; quality `fast` or `full`, where there is a difference."""
        ...

    def snapshot(self) -> Any:
        """The state now, to which `restore` goes back bit for bit. Only called where the specification has `snapshots`."""
        ...

    def restore(self, snapshot: Any) -> None:
        """Back to a snapshot of this environment."""
        ...

    def close(self) -> None:
        """Let go of windows, contexts and processes."""
        ...


@runtime_checkable
class TakesChunks(Protocol):
    """An environment that takes several actions at once, such as one in another process, where every message costs.

    The episode loop sends chunks where nobody watches single steps (a video does).
    """

    def advance_chunk(self, actions: NDArray[Any]) -> int:
        """Make the actions (T, D) one after the other until `done`. Returns how many were made."""
        ...


@runtime_checkable
class LooksAhead(TakesChunks, Protocol):
    """An environment that can look at once where a chunk ends, so that what is seen there need not be asked for."""

    def advance_and_look(self, actions: NDArray[Any], cameras: Sequence[str], size: int) -> int:
        """As `advance_chunk`. Unless the episode is over, `observe` will be asked for these cameras in this size next."""
        ...


class Expert(Protocol):
    """A scripted expert that sees the simulator's state."""

    def act(self) -> NDArray[Any]:
        """The next action (D,)."""
        ...


@runtime_checkable
class HasExpert(Protocol):
    """An environment with a scripted expert: what policies of kind `scripted_expert` drive with."""

    def expert(self) -> Expert:
        """The expert of the loaded instance, at the beginning of its plan. It must be looked at by nobody else."""
        ...


@runtime_checkable
class TellsScene(Protocol):
    """An environment that tells one scene from another, so that outcomes of two logs are compared on the same scenes only."""

    def scene_digest(self) -> str:
        """Digest of the scene of the loaded instance with its instruction: another one where anything is that an episode depends on.

        Empty where it cannot be told after all.
        It should not depend on last bits, as of a simulation before the first step, which differ from machine to machine.
        """
        ...


@runtime_checkable
class TellsLandmarks(Protocol):
    """An environment that tells where the things are that its task is about: labels of demonstrations, which no policy is shown."""

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """What they are called, the thing to be handled first; none where it cannot tell."""
        ...

    def landmarks(self, cameras: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Where they are now.

        Args:
            cameras: in whose images they are looked for.

        Returns:
            `positions` (names, 3), metres; for each camera (names, 2), column and row in [-1, 1] of its image, beyond that where out of view. NaN
            for what this task has not.
        """
        ...
