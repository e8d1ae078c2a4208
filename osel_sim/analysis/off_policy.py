"""What another way of choosing would have earned, from a run that noted with which probability it chose.

Only the outcome of the chosen policy is known, so it stands for those that are not: its weight is the probability with which the other way (the
target) chooses that policy, over the one with which it was chosen.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.analysis.log import Array
from osel_sim.core.errors import UsageError
from osel_sim.statistics.intervals import Interval

LEAST_EFFECTIVE = 100.0
"""Estimates that rest on fewer effective decisions are shown nowhere: normal intervals of so few do not hold, and one lucky choice decides. In
simulated runs of `auto`, `thompson`, `lints` and `random` 95 % intervals hold the truth in about 95 % or more from here on, and in
fewer of those that rest on less (`benchmarks/interval_coverage.py`)."""

WAYS = ("ips", "snips", "dr")
"""Fields of `OffPolicyEstimate`, each with its `_ci95` and `_effective`."""

COMPONENTS = 16
"""Directions of the contexts that the reward model looks at."""

RIDGE = 4.0
"""How many decisions the reward model's prior weighs."""

REFITS = 25
"""How often, at most, the reward model is fitted anew along the run."""


@dataclass(frozen=True)
class OffPolicyEstimate:
    """A target's mean reward a decision, three ways, each with its 95 % interval.

    Attributes:
        ips: inverse propensity scoring: unbiased, at the mercy of rare choices.
        snips: the same over the mean weight: slightly biased, steadier.
        dr: doubly robust: a reward model's prediction, corrected by weighted residuals. Unbiased as ips; the better the model, the narrower.
        ips_effective, snips_effective, dr_effective: how many decisions made by the target itself would weigh as much. For snips and dr Kish's
            number of the weights, (sum w)^2 / sum w^2. ips takes the mean weight for the 1 that it is on average; where it came out higher, few
            decisions count for many, and the number is T^2 / sum w^2 (Elvira, Martino and Robert 2018, "Rethinking the effective sample size").
            None is above what the propensities promise, T^2 / sum of target^2 / propensity over all policies: where a rare choice that
            would have weighed much happened not to be made, the weights that were drawn look better than they are.
        effective_decisions: Kish's number.
        mean_weight: what ips takes for 1; ips is snips times this.
        unsupported: share of the target's choices that the run could never have made, so that nothing is known of them; the estimates are None
            where it is not 0.
    """

    ips: float | None
    ips_ci95: Interval | None
    snips: float | None
    snips_ci95: Interval | None
    dr: float | None
    dr_ci95: Interval | None
    ips_effective: float
    snips_effective: float
    dr_effective: float
    effective_decisions: float
    mean_weight: float
    unsupported: float

    @property
    def few(self) -> tuple[str, ...]:
        """Which of the three rest on too few decisions to be shown (`LEAST_EFFECTIVE`)."""
        return tuple(way for way in WAYS if getattr(self, f"{way}_effective") < LEAST_EFFECTIVE)


def estimate(rewards: ArrayLike, chosen: ArrayLike, propensities: ArrayLike, target: ArrayLike, model: ArrayLike | None = None) -> OffPolicyEstimate:
    """Estimate a target's mean reward.

    The run may have learned while it ran. For ips and dr each decision's term then still has, given all before it, the target's reward as its
    expectation, so that the intervals (normal, from the terms' variance) hold for long runs; for dr the model must know earlier decisions only.
    Where a rare choice that would have weighed much happened not to be made, the terms vary less than they would on average. The propensities tell
    what the sum of squared weights is on average: the variance is multiplied by that over the sum that was drawn, where that is more than 1.

    Args:
        rewards: (T,) of what was chosen, finite: leave decisions without a valid outcome out.
        chosen: (T,) columns.
        propensities: (T, P) of the run.
        target: (T, P) probabilities with which the target chooses.
        model: (T, P) predicted rewards; None: all 0, so that dr is ips.

    Raises:
        UsageError: shapes that do not fit, rewards that are not finite, or a chosen policy without propensity.
    """
    received, behaviour, wanted = np.asarray(rewards, np.float64), np.asarray(propensities, np.float64), np.asarray(target, np.float64)
    predicted = np.zeros_like(behaviour) if model is None else np.asarray(model, np.float64)
    columns = np.asarray(chosen, np.int64)
    if received.ndim != 1 or not received.size or not behaviour.shape == wanted.shape == predicted.shape or len(behaviour) != len(received):
        raise UsageError(f"rewards (T,), propensities, target and model (T, P) do not fit: {received.shape}, {behaviour.shape}, {wanted.shape}")
    if not np.isfinite(received).all() or not np.isfinite(predicted).all():
        raise UsageError("rewards and predictions must be finite; an episode that ended in error has no reward")
    rows = np.arange(len(received))
    if not (behaviour[rows, columns] > 0.0).all():
        raise UsageError("a policy was chosen that had no propensity")
    weights = wanted[rows, columns] / behaviour[rows, columns]
    unsupported = float(np.where(behaviour > 0.0, 0.0, wanted).sum(axis=1).mean())
    squares = float((weights**2).sum())
    effective = float(weights.sum()) ** 2 / squares if squares > 0.0 else 0.0
    mean_weight = float(weights.mean())
    promised = np.divide(wanted**2, behaviour, out=np.zeros_like(wanted), where=behaviour > 0.0).sum()
    own = min(effective, len(weights) ** 2 / float(promised)) if promised > 0.0 else 0.0
    counts = (min(own, len(weights) ** 2 / squares) if squares > 0.0 else 0.0, own, own, effective, mean_weight, unsupported)
    if unsupported > 0.0 or effective == 0.0:
        return OffPolicyEstimate(None, None, None, None, None, None, *counts)
    snips = float((weights * received).sum() / weights.sum())
    dr_terms = (wanted * predicted).sum(axis=1) + weights * (received - predicted[rows, columns])
    wider = max(1.0, float(promised) / squares) ** 0.5
    ips, ips_interval = _mean(weights * received, wider)
    dr, dr_interval = _mean(dr_terms, wider)
    _, (low, high) = _mean(weights * (received - snips) / mean_weight, wider)
    return OffPolicyEstimate(ips, ips_interval, snips, (snips + low, snips + high), dr, dr_interval, *counts)


def forward_model(contexts: NDArray[np.float32], rewards: Array, chosen: NDArray[np.int64], policies: int) -> Array:
    """Predicted reward of every policy in every decision, (T, P), from a linear model of the decisions before it; 0 before the first.

    Ridge regression by policy on the leading directions of the contexts, scaled to unit variance; a policy's mean is drawn towards that of all. It is
    fitted anew as decisions accumulate, so that no prediction knows its own reward or a later one.

    Args:
        contexts: (T, D). rewards: (T,). chosen: (T,) columns.
    """
    features = _leading(contexts)
    predictions = np.zeros((len(rewards), policies))
    starts = np.unique(np.geomspace(8, max(9, len(rewards)), REFITS).astype(np.int64))
    for start, stop in zip(starts, [*starts[1:], len(rewards)], strict=True):
        if start >= len(rewards):
            break
        overall = rewards[:start].mean()
        for policy in range(policies):
            own = np.flatnonzero(chosen[:start] == policy)
            mean = (rewards[own].sum() + overall) / (len(own) + 1.0)
            slope = _ridge(features[own], rewards[own] - mean)
            predictions[start:stop, policy] = mean + features[start:stop] @ slope
    return predictions


def greedy(model: Array) -> Array:
    """Probabilities (T, P) of always choosing the policy of the highest prediction; equal ones share."""
    best = model == model.max(axis=1, keepdims=True)
    return np.asarray(best / best.sum(axis=1, keepdims=True), np.float64)


def _leading(contexts: NDArray[np.float32]) -> Array:
    centred = contexts.astype(np.float64) - contexts.mean(axis=0, dtype=np.float64)
    left, values, _ = np.linalg.svd(centred, full_matrices=False)
    kept = int((values > 1e-6 * max(float(values[0]), 1e-300)).sum())
    return np.asarray(left[:, : min(COMPONENTS, kept)] * np.sqrt(len(contexts)), np.float64)


def _ridge(features: Array, targets: Array) -> Array:
    # The prior grows with the number of directions: each of them then has to be paid for.
    count = features.shape[1]
    return np.asarray(np.linalg.solve(features.T @ features + RIDGE * max(1, count) * np.eye(count), features.T @ targets), np.float64)


def _mean(terms: Array, wider: float) -> tuple[float, Interval]:
    """Mean with its normal interval, so many times as wide as the terms' deviation makes it."""
    mean = float(terms.mean())
    half = wider * NormalDist().inv_cdf(0.975) * float(terms.std(ddof=1)) / np.sqrt(len(terms)) if len(terms) > 1 else float("inf")
    return mean, (mean - half, mean + half)
