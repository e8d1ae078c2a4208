"""Asking a policy for actions, with what the answer took: the same for a policy on the robot and one behind a network."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from osel_sim.interface.environment import Environment
from osel_sim.interface.policy import Actions, Observation


@dataclass(frozen=True)
class Call:
    """One answer of a policy.

    Attributes:
        actions: (T, D) float32 within the environment's bounds; None exactly when the call failed.
        upload, inference, download: seconds on the virtual clock; deterministic, never this machine's speed.
        megabytes: moved both ways (10^6 bytes); 0 for a local policy.
        measured_seconds: what the call really took here; for `timing.jsonl` only.
        failure: why there are no actions (`deadline`, `outage`, or a sentence), or None.
        sent: the policy was asked. False where it could not be reached: that costs time, but is no call and has no price.
        paid, paid_per_action: cents for this call, and for every action of it that is executed, beyond the price in the policy's file: of a merge,
            whose parts have prices of their own.
    """

    actions: Actions | None
    upload: float = 0.0
    inference: float = 0.0
    download: float = 0.0
    megabytes: float = 0.0
    measured_seconds: float = 0.0
    failure: str | None = None
    sent: bool = True
    paid: float = 0.0
    paid_per_action: float = 0.0

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


@runtime_checkable
class Privileged(Protocol):
    """A caller that wants to see the world itself; the episode loop shows it the environment before anything else."""

    def bind(self, env: Environment) -> None:
        """Remember the environment of the coming episode. It must be looked at, never changed."""
        ...
