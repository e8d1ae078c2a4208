"""Asking a policy for actions, with what the answer took: the same for a policy on the robot and one behind a network."""

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from osel_sim.core.errors import PolicyError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.policy import ACTION_DIM, Actions, Observation, Policy

MAX_CHUNK = 1000  # actions in one answer; 50 s at 20 Hz, far beyond any policy's chunk


@dataclass(frozen=True)
class Call:
    """One answer of a policy.

    Attributes:
        actions: (T, 7) float32 in [-1, 1]; None exactly when the call failed.
        upload, inference, download: seconds on the virtual clock; deterministic, never this machine's speed.
        megabytes: moved both ways (10^6 bytes); 0 for a local policy.
        measured_seconds: what the call really took here; for `timing.jsonl` only.
        failure: why there are no actions (`deadline`, `outage`, or a sentence), or None.
    """

    actions: Actions | None
    upload: float = 0.0
    inference: float = 0.0
    download: float = 0.0
    megabytes: float = 0.0
    measured_seconds: float = 0.0
    failure: str | None = None

    def __post_init__(self) -> None:
        if (self.actions is None) == (self.failure is None):
            raise ValueError("a call has either actions or a failure")

    @property
    def seconds(self) -> float:
        """Upload + inference + download: how long the robot waited, on the virtual clock."""
        return self.upload + self.inference + self.download


class Caller(Protocol):
    """What the episode loop talks to."""

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Start a new episode.

        Args:
            instruction: what to do.
            seed: what fixes the network's delays, such as (instance, policy, repeat) as integers >= 0.
        """
        ...

    def call(self, observation: Observation) -> Call:
        """The next chunk of actions, or why there is none. Never hangs; a policy that cannot be reached is a failed call, not an exception."""
        ...

    def close(self) -> None:
        """Let go of sockets and processes. May be called twice."""
        ...


def check_actions(value: Any) -> Actions:
    """A policy's raw answer as (T, 7) float32, clipped to [-1, 1].

    Clipped, since policies trained by regression overshoot the range a little and OSC_POSE would clip as well; a wrong shape or a number that is
    none has no such harmless reading.

    Raises:
        PolicyError: saying what is wrong.
    """
    try:
        actions = np.asarray(value)
    except ValueError as error:  # ragged lists
        raise PolicyError(f"actions are not an array ({error})") from None
    if actions.dtype.kind not in "fiu":
        raise PolicyError(f"actions must be real numbers, got dtype {actions.dtype}")
    if actions.ndim != 2 or actions.shape[1] != ACTION_DIM or not 1 <= actions.shape[0] <= MAX_CHUNK:
        raise PolicyError(f"actions must have the shape (T, {ACTION_DIM}) with 1 <= T <= {MAX_CHUNK}, got {actions.shape}")
    if not np.isfinite(actions).all():
        raise PolicyError("actions contain NaN or infinity")
    return np.clip(actions, -1.0, 1.0).astype(np.float32)


class LocalCaller:
    """A policy on the robot itself: no network, the declared inference time.

    An answer of a wrong form is a failed call; an exception of the policy's own code passes through, since it is a bug to be seen.
    """

    def __init__(self, policy: Policy, spec: PolicySpec) -> None:
        self._policy, self._spec = policy, spec

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Start a new episode; there is nothing to seed."""
        self._policy.reset(instruction)

    def call(self, observation: Observation) -> Call:
        """The next chunk of actions, after the declared inference time."""
        start = time.perf_counter()
        answer = self._policy.act(observation)
        measured = time.perf_counter() - start
        try:
            actions = check_actions(answer)
        except PolicyError as error:
            return Call(None, inference=self._spec.inference_seconds, measured_seconds=measured, failure=str(error))
        return Call(actions, inference=self._spec.inference_seconds, measured_seconds=measured)

    def close(self) -> None:
        """Nothing to let go of."""
