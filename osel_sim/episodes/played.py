"""What came of a decision's episodes, before it is written down."""

from dataclasses import dataclass, field
from typing import Any

from osel_sim.interface.outcome import Outcome


@dataclass(frozen=True)
class Played:
    """The episodes of one decision.

    Attributes:
        outcome: of the policy that was chosen.
        scene: as `osel_sim.episodes.start.Start` has it.
        others: policy -> what it came to, of those that were not chosen, where they ran as well.
        alone: what the chosen one comes to without the monitor; None where that did not run.
        seconds, took: how long all of it took, and what `timing.jsonl` has of its episodes, where they ran in another process.
    """

    outcome: Outcome
    scene: str | None = None
    others: dict[str, Outcome] = field(default_factory=dict)
    alone: Outcome | None = None
    seconds: float = 0.0
    took: dict[str, Any] = field(default_factory=dict)
