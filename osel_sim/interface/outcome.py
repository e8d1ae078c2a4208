"""What came of one episode."""

from dataclasses import asdict, dataclass
from typing import Any

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

    def __post_init__(self) -> None:
        for name in ("fallback", "error"):  # servers and policies have a say in them
            told = getattr(self, name)
            if isinstance(told, str):
                object.__setattr__(self, name, shown(told))

    def to_dict(self) -> dict[str, Any]:
        """As plain data, `seconds` a dictionary of its own."""
        return asdict(self)
