"""The reward of an outcome: r = S - alpha_time * time - alpha_price * price (paper, equation "reward")."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.formats.rollout_log import Row
from osel_sim.interface.outcome import Outcome, Seconds

TimeUnit = Literal["log10-seconds", "steps"]
Success = Literal["success", "subgoals", "score"]

FLOOR_SECONDS = 0.05
"""One control step. Nothing here is quicker, and the logarithm of no time at all has no value."""


@dataclass(frozen=True)
class RewardWeights:
    """What matters to the user, and how much.

    Attributes:
        alpha_time: weight of the time, >= 0.
        alpha_price: weight of the price in cents, >= 0.
        time_unit: time is the log10 of the total seconds, or the number of control steps.
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


PRESETS = {
    "mmlu": RewardWeights(0.03, 0.0008),
    "waymo": RewardWeights(0.2, 0.001),
    "alfred": RewardWeights(0.05, 0.005, "steps", "subgoals"),
    "oxe": RewardWeights(0.2, 0.01),
}
"""The paper's weights (appendix "Weights"). Time is log10 seconds, in ALFRED the robot's steps: there whole skills, some tens an episode, so that
at 20 control steps a second its alpha_time weighs heavily. S of Open X-Embodiment is minus the action MSE in the paper, for want of an environment
to try the actions in; here the task's success is known and takes its place. A log of `osel_sim.ingest --metric action-mse` has the paper's S as
its score: `replace(preset("oxe"), success="score")`."""


def preset(name: str) -> RewardWeights:
    """Weights of one of the paper's workloads.

    Raises:
        UnknownNameError: no such preset.
    """
    if name not in PRESETS:
        raise UnknownNameError("reward preset", name, PRESETS)
    return PRESETS[name]


def total_seconds(seconds: Seconds) -> float:
    """Seconds from the instruction to the end of the episode.

    While an answer is on its way the robot holds still or finishes its chunk, and steps go by either way, so `motion` contains all waiting and the
    other three are not added to it. Where nothing moves (a logged answer to a question) the time is the waiting itself.
    """
    return max(seconds.motion, seconds.upload + seconds.inference + seconds.download)


def logged_seconds(row: Row) -> float | None:
    """Total seconds of a row of a rollout log, as `total_seconds`; of its four times those that are null count as none, and None where all are."""
    parts = (row.upload, row.inference, row.download, row.motion)
    return None if all(part is None for part in parts) else total_seconds(Seconds(*(part or 0.0 for part in parts)))


def reward(outcome: Outcome, weights: RewardWeights) -> float:
    """Reward of an outcome.

    Raises:
        UsageError: the episode ended in error, which is nobody's failure and has no reward; or S is to be a score, which no episode has.
    """
    if outcome.error is not None:
        raise UsageError(f"an episode that ended in error has no reward: {outcome.error}")
    if weights.success == "score":
        raise UsageError("an episode has no score; S must be 'success' or 'subgoals'")
    score = float(outcome.success) if weights.success == "success" else outcome.subgoals
    time = float(outcome.steps) if weights.time_unit == "steps" else _logarithm(total_seconds(outcome.seconds))
    return score - weights.alpha_time * time - weights.alpha_price * outcome.price


def logged_reward(row: Row, weights: RewardWeights) -> float | None:
    """Reward of a row of a rollout log; None where it ended in error, or where the log lacks what the weights ask for.

    What has no weight need not be known.
    """
    if row.error is not None:
        return None
    if weights.success == "success":
        score: float | None = float(row.success)
    else:
        score = row.subgoals if weights.success == "subgoals" else row.score
    time: float | None = 0.0
    if weights.alpha_time:
        seconds = logged_seconds(row)
        time = row.steps if weights.time_unit == "steps" else None if seconds is None else _logarithm(seconds)
    price = row.price if weights.alpha_price else 0.0
    if score is None or time is None or price is None:
        return None
    return score - weights.alpha_time * time - weights.alpha_price * price


def _logarithm(seconds: float) -> float:
    return math.log10(max(seconds, FLOOR_SECONDS))
