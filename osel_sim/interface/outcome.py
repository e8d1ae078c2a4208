"""What came of one episode."""

import math
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

    def __post_init__(self) -> None:
        for name in ("fallback", "error"):  # servers and policies have a say in them
            told = getattr(self, name)
            if isinstance(told, str):
                object.__setattr__(self, name, shown(told))

    def to_dict(self) -> dict[str, Any]:
        """As plain data, `seconds` a dictionary of its own; `fallback_steps` only where a fallback took over."""
        data = asdict(self)
        if self.fallback_steps is None:
            del data["fallback_steps"]
        return data


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
