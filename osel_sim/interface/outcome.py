"""What came of one episode."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

from osel_sim.core.shown import shown


@dataclass(frozen=True)
class Seconds:
    """Where an episode's time went, in seconds on the virtual clock (never this machine's speed).

    While a remote call is answered the robot holds still and physics goes on, so `motion` (steps / control rate) already contains that wait.
    """

    upload: float = 0.0
    inference: float = 0.0
    download: float = 0.0
    motion: float = 0.0


MONITORED_VERSION = 1
"""Of the form of `Monitored` in journals."""


@dataclass(frozen=True)
class Handoff:
    """Control passed from one policy to another.

    Attributes:
        step: control steps of the episode by then.
        call: calls by then.
        driver: who drove until then (`from` in files).
        to: who drives from then on.
        why: the monitor's words.
    """

    step: int
    call: int
    driver: str
    to: str
    why: str


@dataclass(frozen=True)
class Driving:
    """What one policy had of an episode: control steps (its waiting included), calls, actions made, cents. One that was only asked drove no steps."""

    steps: int
    calls: int
    actions: int
    price: float


@dataclass(frozen=True)
class Monitored:
    """What a monitor made of an episode.

    Attributes:
        points: decision points that it looked at.
        handoffs: in order.
        duty_steps, duty_calls: share of the control steps that remote policies drove, and of the calls that went to them; 0 where there are none.
        by_policy: of every policy that drove or was asked, a fallback included; their prices sum to the episode's.
    """

    points: int
    handoffs: tuple[Handoff, ...]
    duty_steps: float
    duty_calls: float
    by_policy: Mapping[str, Driving]

    def to_dict(self) -> dict[str, Any]:
        """As a journal has it."""
        handoffs = [{"step": one.step, "call": one.call, "from": one.driver, "to": one.to, "why": one.why} for one in self.handoffs]
        return {
            "version": MONITORED_VERSION,
            "points": self.points,
            "handoffs": handoffs,
            "duty": {"steps": self.duty_steps, "calls": self.duty_calls},
            "by_policy": {policy: asdict(driving) for policy, driving in self.by_policy.items()},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Monitored":
        """What `to_dict` gave; raises KeyError or TypeError if it is nothing of the kind."""
        handoffs = tuple(Handoff(one["step"], one["call"], one["from"], one["to"], one["why"]) for one in data["handoffs"])
        by_policy = {policy: Driving(**driving) for policy, driving in data["by_policy"].items()}
        return cls(data["points"], handoffs, data["duty"]["steps"], data["duty"]["calls"], by_policy)


@dataclass(frozen=True)
class Outcome:
    """Outcome of one policy on one instance.

    Attributes:
        success: the goal predicates held at the end.
        subgoals: fraction of the task's subgoals reached, in [0, 1].
        steps: control steps, waiting included.
        seconds: upload, inference, download, motion.
        calls: how often the policy was asked for a chunk of actions; one that could not be reached was not asked.
        actions: how many of its actions were executed.
        price: in cents (policy file: per action, per call, per megabyte).
        fallback: why a fallback policy had to take over, or None.
        error: why there is no valid outcome (a crash, a dead server without fallback), or None. Never counted as a policy's failure.
        fallback_steps: of `steps` those that the fallback drove; None where none took over (or an earlier version did not count them).
        monitored: handoffs, duty and what each policy had of it; None where no monitor watched. `calls` and `actions` are then those of all policies
            that drove, a fallback's not counted.
    """

    success: bool
    subgoals: float
    steps: int
    seconds: Seconds
    calls: int
    actions: int
    price: float
    fallback: str | None = None
    error: str | None = None
    fallback_steps: int | None = None
    monitored: Monitored | None = None

    def __post_init__(self) -> None:
        for name in ("fallback", "error"):  # servers and policies have a say in them
            told = getattr(self, name)
            if isinstance(told, str):
                object.__setattr__(self, name, shown(told))

    def to_dict(self) -> dict[str, Any]:
        """As plain data; `fallback_steps` only where a fallback took over, `monitored` only where a monitor watched."""
        data = asdict(self)
        if self.fallback_steps is None:
            del data["fallback_steps"]
        del data["monitored"]
        return data if self.monitored is None else data | {"monitored": self.monitored.to_dict()}


class Driven(Protocol):
    """An episode, as outcomes, decisions and rows of a log have it; what is not known is None."""

    @property
    def success(self) -> bool:
        """The goal was reached, whoever drove."""
        ...

    @property
    def subgoals(self) -> float | None:
        """Fraction of the subgoals reached, whoever drove."""
        ...

    @property
    def actions(self) -> int | None:
        """How many of the policy's own actions were made."""
        ...

    @property
    def fallback(self) -> str | None:
        """Why a fallback took over."""
        ...


def stood_in(episode: Driven) -> bool:
    """Whether a fallback drove from the first call on: the policy itself did nothing."""
    return episode.fallback is not None and episode.actions == 0


def credited(episode: Driven, measure: Literal["success", "subgoals"]) -> float:
    """What of an episode's success or subgoals counts for the policy that was asked: nothing, where a fallback drove from the first call on.

    Else a policy whose server is dead would be as good as its fallback. It is charged for time and price all the same, so that selectors learn to
    keep away from a policy that cannot be reached. One that made an action or more before the fallback took over is credited: its choice led there.

    Returns:
        NaN where it is not known.
    """
    value = getattr(episode, measure)
    return math.nan if value is None else 0.0 if stood_in(episode) else float(value)
