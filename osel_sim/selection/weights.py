"""Weights of the reward and the paper's presets. Imports nothing heavy: `--list` shows them."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from osel_sim.core.errors import UnknownNameError, UsageError

TimeUnit = Literal["log10-seconds", "log10-steps", "steps"]
Success = Literal["success", "subgoals", "score"]


@dataclass(frozen=True)
class RewardWeights:
    """What matters to the user, and how much.

    Attributes:
        alpha_time: weight of the time, >= 0.
        alpha_price: weight of the price in cents, >= 0.
        time_unit: time is the log10 of the total seconds, the log10 of the number of control steps, or that number itself.
        success: S is 1 or 0 for the goal, the fraction of the subgoals reached, or the score of a log that has one (minus the action MSE).

    Raises:
        UsageError: a weight is negative or not finite.
        UnknownNameError: no such time unit or kind of success.
    """

    alpha_time: float
    alpha_price: float
    time_unit: TimeUnit = "log10-seconds"
    success: Success = "success"

    def __post_init__(self) -> None:
        for name in ("alpha_time", "alpha_price"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"{name} must be a finite number >= 0, got {value}")
        if self.time_unit not in get_args(TimeUnit):
            raise UnknownNameError("time unit", self.time_unit, get_args(TimeUnit))
        if self.success not in get_args(Success):
            raise UnknownNameError("kind of success", self.success, get_args(Success))

    @property
    def clock(self) -> Literal["seconds", "steps"]:
        """What the time is counted in, before any logarithm."""
        return "seconds" if self.time_unit == "log10-seconds" else "steps"

    @property
    def time_text(self) -> str:
        """The time in a formula: `log10(seconds)`, `log10(steps)` or `steps`."""
        return f"log10({self.clock})" if self.time_unit.startswith("log10-") else self.clock


PRESETS = {
    "mmlu": RewardWeights(0.03, 0.0008),
    "waymo": RewardWeights(0.2, 0.001),
    "alfred": RewardWeights(0.05, 0.005, "log10-steps", "subgoals"),
    "oxe": RewardWeights(0.2, 0.01),
}
"""The paper's weights (appendix "Weights"). Time is log10 seconds, in ALFRED log10 of the robot's steps. The text of the paper says steps there; its
authors' code takes their logarithm, and 0.05 a step would make a success of 100 steps worth -4. S of Open X-Embodiment is minus the action MSE in the
paper, for want of an environment to try the actions in; here the task's success is known and takes its place. A log of
`osel_sim.ingest --metric action-mse` has the paper's S as its score: `replace(preset("oxe"), success="score")`."""


def preset(name: str) -> RewardWeights:
    """Weights of one of the paper's workloads.

    Raises:
        UnknownNameError: no such preset.
    """
    if name not in PRESETS:
        raise UnknownNameError("reward preset", name, PRESETS)
    return PRESETS[name]
