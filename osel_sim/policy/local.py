"""A policy on the robot itself, and the check of what any policy answers."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import PolicyError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.policy import Actions, Observation, Policy

MAX_CHUNK = 1000  # actions in one answer; 50 s at 20 Hz, far beyond any policy's chunk


def check_actions(value: Any, action: ActionSpec) -> Actions:
    """A policy's raw answer as (T, D) float32, clipped to the environment's bounds.

    Clipped, since policies trained by regression overshoot the range a little and robots would clip as well; a wrong shape or a number that is
    none has no such harmless reading.

    Raises:
        PolicyError: saying what is wrong.
    """
    return action.clip(check_form(value, action.dimension))


def check_form(value: Any, dimension: int) -> NDArray[Any]:
    """A policy's raw answer as (T, dimension) finite real numbers.

    Raises:
        PolicyError: saying what is wrong.
    """
    try:
        actions = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise PolicyError(f"actions are not an array ({error})") from None
    if actions.dtype.kind not in "fiu":
        raise PolicyError(f"actions must be real numbers, got dtype {actions.dtype}")
    if actions.ndim != 2 or actions.shape[1] != dimension or not 1 <= actions.shape[0] <= MAX_CHUNK:
        raise PolicyError(f"actions must have the shape (T, {dimension}) with 1 <= T <= {MAX_CHUNK}, got {actions.shape}")
    if not np.isfinite(actions).all():
        raise PolicyError("actions contain NaN or infinity")
    return actions


class LocalCaller:
    """A policy on the robot itself: no network, the declared inference time.

    An answer of a wrong form is a failed call; an exception of the policy's own code passes through, since it is a bug to be seen.
    """

    def __init__(self, policy: Policy, spec: PolicySpec, environment: EnvironmentSpec) -> None:
        self._policy, self._spec, self._action = policy, spec, environment.action

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Start a new episode; there is nothing to seed."""
        self._policy.reset(instruction)

    def call(self, observation: Observation) -> Call:
        """The next chunk of actions, after the declared inference time."""
        start = time.perf_counter()
        answer = self._policy.act(observation)
        measured = time.perf_counter() - start
        try:
            actions = check_actions(answer, self._action)
        except PolicyError as error:
            return Call(None, inference=self._spec.inference_seconds, measured_seconds=measured, failure=str(error))
        return Call(actions, inference=self._spec.inference_seconds, measured_seconds=measured)

    def close(self) -> None:
        """Nothing to let go of."""
