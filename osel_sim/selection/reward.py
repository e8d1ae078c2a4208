"""The reward of an outcome: r = S - alpha_time * time - alpha_price * price (paper, equation "reward").

Everything here works on arrays, NaN standing for what is not known; a single outcome is an array without dimensions.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import DataError, OselError, UsageError
from osel_sim.formats.rollout_log import Row
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import AMOUNT, TEXT, fault
from osel_sim.interface.outcome import Outcome, credited, stood_in
from osel_sim.selection.weights import PRESETS as PRESETS
from osel_sim.selection.weights import RewardWeights as RewardWeights
from osel_sim.selection.weights import preset as preset

Array = NDArray[np.float64]

FLOOR_SECONDS = 0.05
"""One control step. Nothing here is quicker, and the logarithm of no time at all has no value."""
FLOOR_STEPS = 1.0
"""The same in steps."""


def combined(weights: RewardWeights, score: ArrayLike, time: ArrayLike, price: ArrayLike) -> Array:
    """The reward: S - alpha_time * time - alpha_price * price, elementwise. What has no weight is left out, so that it need not be known.

    Args:
        score: S, as `weights.success` wants it.
        time: as `counted_time` counts it.
        price: cents.
    """
    value = np.array(score, np.float64)
    if weights.alpha_time > 0.0:
        value = value - weights.alpha_time * np.asarray(time, np.float64)
    if weights.alpha_price > 0.0:
        value = value - weights.alpha_price * np.asarray(price, np.float64)
    return value


def charge(weights: RewardWeights, time: ArrayLike, price: ArrayLike) -> Array:
    """What an outcome's time and price take off its reward: alpha_time * time + alpha_price * price."""
    nothing = np.zeros(np.broadcast_shapes(np.shape(time), np.shape(price)))
    return np.asarray(nothing - combined(weights, nothing, time, price), np.float64)


def counted_time(weights: RewardWeights, steps: ArrayLike, seconds: ArrayLike) -> Array:
    """Time as the reward counts it: log10 of the total seconds or of the control steps, or the control steps."""
    if weights.time_unit == "steps":
        return np.asarray(steps, np.float64)
    time, floor = (seconds, FLOOR_SECONDS) if weights.clock == "seconds" else (steps, FLOOR_STEPS)
    floored = np.maximum(np.asarray(time, np.float64), floor)
    # numpy's vectorised logarithm and the C library's differ in the last bit (for 9% of times); journals hold the one, results of replays the other.
    return np.asarray(np.log10(floored) if floored.ndim else math.log10(floored), np.float64)


def total_seconds(upload: ArrayLike, inference: ArrayLike, download: ArrayLike, motion: ArrayLike) -> Array:
    """Seconds from the instruction to the end of the episode; of the four times those that are NaN count as none, and NaN where all are.

    While an answer is on its way the robot holds still or finishes its chunk, and steps go by either way, so `motion` contains all waiting and the
    other three are not added to it. Where nothing moves (a logged answer to a question) the time is the waiting itself.
    """
    parts = np.stack([np.asarray(part, np.float64) for part in (upload, inference, download)])
    waiting = np.where(np.isfinite(parts).any(axis=0), np.nansum(parts, axis=0), np.nan)
    return np.asarray(np.fmax(motion, waiting), np.float64)


def reward(outcome: Outcome, weights: RewardWeights) -> float:
    """Reward of an outcome; a success that is all a fallback's is none (`osel_sim.interface.outcome.credited`).

    Raises:
        UsageError: the episode ended in error, which is nobody's failure and has no reward; or S is to be a score, which no episode has.
    """
    if outcome.error is not None:
        raise UsageError(f"an episode that ended in error has no reward: {outcome.error}")
    if weights.success == "score":
        raise UsageError("an episode has no score; S must be 'success' or 'subgoals'")
    time = counted_time(weights, outcome.steps, total_seconds(**vars(outcome.seconds)))
    return float(combined(weights, credited(outcome, weights.success), time, outcome.price))


def to_go(reward: float, seconds: Sequence[float], steps: Sequence[int], prices: Sequence[float], weights: RewardWeights) -> tuple[float, ...]:
    """Reward-to-go from moments of an episode: its reward without what time and price up to there took off it. Their differences sum to the reward.

    Args:
        reward: of the whole episode.
        seconds, steps, prices: until each moment, as `total_seconds`, control steps and cents.
    """
    return tuple(
        reward + float(charge(weights, counted_time(weights, step, second), price))
        for second, step, price in zip(seconds, steps, prices, strict=True)
    )


def check_reward(value: float | None, outcome: Outcome, weights: RewardWeights, place: str) -> None:
    """Refuse a reward that was written down, and is not what its outcome comes to.

    Args:
        place: of both, such as file and line.

    Raises:
        DataError: naming the place, and the reward that would be right.
    """
    if stood_in(outcome) and outcome.fallback_steps is None:
        return  # of an earlier version, which credited the policy with what its fallback did
    right = None if outcome.error is not None else reward(outcome, weights)
    # Another machine's logarithm may differ in the last bit.
    if (value is None) != (right is None) or (value is not None and right is not None and not math.isclose(value, right, rel_tol=1e-9, abs_tol=1e-9)):
        raise DataError(f"{place}: reward is {quoted(value)}, its outcome comes to {quoted(right)}")


def weights_from(data: Any, place: str) -> RewardWeights:
    """Weights that were written down as JSON.

    Args:
        place: where, for the error.

    Raises:
        DataError: they do not have the promised form.
    """
    if not isinstance(data, dict):
        raise DataError(f"{place} must be an object of {', '.join(_JSON)}, got {quoted(data)}")
    if problem := fault(data, _JSON):
        raise DataError(f"{place}: {problem}")
    try:
        return RewardWeights(**data)
    except OselError as error:
        raise DataError(f"{place}: {error}") from None


_JSON = {"alpha_time": AMOUNT, "alpha_price": AMOUNT, "time_unit": TEXT, "success": TEXT}


def row_seconds(rows: Sequence[Row]) -> Array:
    """Total seconds of rows of a rollout log, (n,), as `total_seconds`."""
    return total_seconds(*(_column(rows, name) for name in ("upload", "inference", "download", "motion")))


def row_rewards(rows: Sequence[Row], weights: RewardWeights) -> Array:
    """Rewards of rows of a rollout log, (n,); NaN where one ended in error, or where the log lacks what the weights ask for."""
    time = counted_time(weights, _column(rows, "steps"), row_seconds(rows))
    scores = _column(rows, "score") if weights.success == "score" else np.array([credited(row, weights.success) for row in rows], np.float64)
    values = combined(weights, scores, time, _column(rows, "price"))
    return np.where([row.error is None for row in rows], values, np.nan)


def _column(rows: Sequence[Row], name: str) -> Array:
    return np.array([getattr(row, name) for row in rows], np.float64)  # None becomes NaN
