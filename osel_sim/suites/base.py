"""What most environments have in common, for suites of others: a suite says how its simulator starts, steps and renders, and the rest is here."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.environment import EnvironmentSpec, Image
from osel_sim.interface.instance import Instance, SeededInstance
from osel_sim.interface.policy import Actions, Observation


@dataclass(frozen=True)
class PlainInstance(SeededInstance):
    """An instance that can be sent to another process.

    Attributes:
        details: what else fixes it, as plain data: numbers, texts, lists and maps of such.
    """

    details: Mapping[str, Any] = field(default_factory=dict)


class BaseEnvironment(ABC):
    """An `Environment` without snapshots that counts its own steps. Overwrite `start`, `act` and `render`, and what else is different.

    Args:
        specification: what it offers policies.
        horizon: control steps after which an episode ends.
    """

    def __init__(self, specification: EnvironmentSpec, horizon: int) -> None:
        self.specification, self.horizon = specification, horizon
        self.instance: Any = None
        self.steps, self.success = 0, False
        self._scene = ""

    # -- a suite's own -------------------------------------------------------------------------------------------------

    @abstractmethod
    def start(self, instance: Any) -> None:
        """Reset the simulator to an instance: the same one gives the same bits."""

    @abstractmethod
    def act(self, action: Actions) -> bool:
        """One control step with an action (D,). Returns whether the task is done now."""

    @abstractmethod
    def render(self, camera: str) -> Image:
        """Image (H, W, 3) RGB of a camera as it stands, of any size; looking must change nothing."""

    def state(self) -> Mapping[str, ArrayLike]:
        """Numbers of each part of the state that the specification lists; none by default."""
        return {}

    def hold_action(self) -> Actions:
        """The action (D,) that holds still: zero, for actions that are changes. Others must say."""
        return self.specification.action.clip(np.zeros(self.specification.action.dimension))

    def scene(self) -> str:
        """Digest of the scene that `start` has just set up (`osel_sim.suites.scenes` helps), so that two logs can be compared scene by scene.

        Empty, as by default, where it cannot be told.
        """
        return ""

    @property
    def subgoal_fraction(self) -> float:
        """Share of the subgoals reached so far; success where there are none."""
        return float(self.success)

    def close(self) -> None:  # noqa: B027 (there may be nothing to do)
        """Let go of windows, contexts and processes; nothing by default."""

    # -- the same for all ----------------------------------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """Success, or the horizon is reached."""
        return self.success or self.steps >= self.horizon

    def load(self, instance: Instance) -> None:
        """Reset to an instance."""
        self.instance = instance
        self.steps, self.success = 0, False
        self.start(instance)
        self._scene = self.scene()

    def scene_digest(self) -> str:
        """Digest of the scene as it was loaded; empty where it cannot be told."""
        return self._scene

    def advance(self, action: NDArray[Any]) -> None:
        """One control step."""
        self.success = bool(self.act(np.asarray(action, np.float32)))
        self.steps += 1

    def observe(self, cameras: Sequence[str], size: int) -> Observation:
        """What a policy is shown now."""
        observation: Observation = {f"observation.images.{camera}": self.image(camera, size, size) for camera in cameras}
        if self.specification.state:
            parts = self.state()
            observation["observation.state"] = np.concatenate([self._part(parts, name) for name in self.specification.state])
        return {**observation, "task": self.instance.instruction}

    def image(self, camera: str, width: int, height: int, quality: str = "fast") -> Image:
        """Image (height, width, 3) of a camera; one quality."""
        return resized(self.render(camera), width, height)

    def snapshot(self) -> Any:
        """There is none by default.

        Raises:
            UsageError: always.
        """
        raise UsageError(f"the environment of {self.specification.name} has no snapshots")

    def restore(self, snapshot: Any) -> None:
        """As `snapshot`."""
        raise UsageError(f"the environment of {self.specification.name} has no snapshots")

    def _part(self, parts: Mapping[str, ArrayLike], name: str) -> NDArray[np.float32]:
        numbers, size = np.atleast_1d(np.asarray(parts.get(name, ()), np.float32)).ravel(), self.specification.state[name]
        if numbers.size != size:
            raise UsageError(f"the environment of {self.specification.name} promises {size} numbers of state {name!r} and gives {numbers.size}")
        return numbers


def resized(image: Image, width: int, height: int) -> Image:
    """The image (H, W, 3) as (height, width, 3): areas are averaged where it shrinks. One of other proportions is stretched."""
    if image.shape[:2] == (height, width):
        return image
    import cv2

    shrinks = image.shape[0] >= height and image.shape[1] >= width
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)
