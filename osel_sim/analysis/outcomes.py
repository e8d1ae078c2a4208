"""What every policy came to on every task (paper, figures 3 and 4), and how often local and remote policies succeed together (table I)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate, mean_of, rate_of
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.units import units_of
from osel_sim.selection.reward import RewardWeights

EVERYTHING = "all"
"""Stands for all tasks together."""


@dataclass(frozen=True)
class PolicyResult:
    """One policy on one task; None where the log has nothing to say.

    Attributes:
        group: the task, or `all`.
        instances: on which it has a valid outcome.
        episodes, errors: valid ones, and those that ended in error (never counted as failures).
        fallbacks, solved_by_fallback: episodes in which a fallback took over, and those of them that it solved.
        success: share of the instances solved, those left out that a fallback solved from the first call on.
        subgoals, score, reward, steps, seconds, price: means; price in cents.
    """

    group: str
    policy: str
    instances: int
    episodes: int
    errors: int
    fallbacks: int
    solved_by_fallback: int
    success: Estimate | None
    subgoals: Estimate | None
    score: Estimate | None
    reward: Estimate | None
    steps: Estimate | None
    seconds: Estimate | None
    price: Estimate | None


@dataclass(frozen=True)
class OutcomeRates:
    """Shares of the episodes by success (S) or failure (F) of a local policy, then of any remote one. They sum to 1.

    Attributes:
        pairs: how many (instance, repeat) have both.
    """

    group: str
    pairs: int
    both: Estimate
    only_local: Estimate
    only_remote: Estimate
    neither: Estimate


def per_group(log: LoggedOutcomes, weights: RewardWeights, attribute: str = "task") -> list[PolicyResult]:
    """Every policy on all instances, then on each task (or target, phrasing ...) apart where there are several."""
    return _results(log, weights, groups(log, attribute))


def overall(log: LoggedOutcomes, weights: RewardWeights) -> list[PolicyResult]:
    """Every policy on all instances."""
    return _results(log, weights, {EVERYTHING: np.ones(len(log), bool)})


def _results(log: LoggedOutcomes, weights: RewardWeights, parts: Mapping[str, NDArray[np.bool_]]) -> list[PolicyResult]:
    rewards, seconds, units = log.rewards(weights), log.seconds, units_of(log)
    return [
        PolicyResult(
            group,
            policy,
            int(np.isfinite(log.success[rows, column]).any(axis=-1).sum()),
            int(np.isfinite(log.success[rows, column]).sum()),
            int(log.errors[rows, column].sum()),
            int(log.fallbacks[rows, column].sum()),
            int(log.solved_by_fallback[rows, column].sum()),
            rate_of(log.success[rows, column], units[rows]),
            *(
                mean_of(mean_over_repeats(values[rows, column]), units[rows])
                for values in (log.subgoals, log.score, rewards, log.steps, seconds, log.price)
            ),
        )
        for group, rows in parts.items()
        for column, policy in enumerate(log.policies)
    ]


def groups(log: LoggedOutcomes, attribute: str = "task") -> dict[str, NDArray[np.bool_]]:
    """All instances under `all`, then each value of an attribute with its instances (N,), where there are several."""
    labels = np.array(log.labels(attribute))
    values = sorted(set(labels.tolist()))
    apart = {value or "(none)": labels == value for value in values} if len(values) > 1 else {}
    return {EVERYTHING: np.ones(len(log), bool), **apart}


def remote_policies(log: LoggedOutcomes) -> tuple[NDArray[np.bool_], str]:
    """Which policies (P,) are remote, and how that is known.

    Those with seconds of upload or download; in a log without such times those that cost money; in one without prices all but the policy with the
    lowest success, which the paper takes for the local one.
    """
    for values, reason in (
        (np.nan_to_num(log.upload) + np.nan_to_num(log.download), "remote: the policies with time for upload or download"),
        (np.nan_to_num(log.price), "remote: the policies that cost money"),
    ):
        remote = (values > 0.0).any(axis=(0, 2))
        if remote.any() and not remote.all():
            return remote, reason
    rates = mean_over_repeats(mean_over_repeats(log.success).T)
    remote = np.ones(len(log.policies), bool)
    remote[int(np.nan_to_num(rates, nan=np.inf).argmin())] = False  # a policy that was never chosen has no rate
    return remote, "local: the policy with the lowest success, as in the paper, because the log has no network times or prices that tell"


def outcome_rates(log: LoggedOutcomes, remote: NDArray[np.bool_], attribute: str = "task") -> list[OutcomeRates]:
    """Table I for all instances and each task. Valid repeats of local and remote policies are paired in their order; the rest is left out.

    Args:
        remote: (P,) which policies are remote; the paper has one local policy, several count as one that succeeds if any does.
    """
    return [rates_of(group, log.success[rows], remote) for group, rows in groups(log, attribute).items()]


def rates_of(group: str, success: Array, remote: NDArray[np.bool_]) -> OutcomeRates:
    """Outcome rates of some instances.

    Args:
        success: (N, P, R), NaN where there is no outcome.
        remote: (P,).
    """
    # Repeats are as good as one another: the first valid one of a policy goes with the first of the others, whatever their numbers.
    success = np.take_along_axis(success, np.argsort(~np.isfinite(success), axis=2, kind="stable"), axis=2)
    local_success, remote_success = success[:, ~remote].max(axis=1), success[:, remote].max(axis=1)  # NaN wherever one of them is
    known = np.isfinite(local_success) & np.isfinite(remote_success)
    instances = known.any(axis=-1)

    def share(local: bool, other: bool) -> Estimate:
        cell = np.where(known, (local_success > 0.5) == local, np.nan) * ((remote_success > 0.5) == other)
        return rate_of(cell[instances]) or Estimate(float("nan"), 0.0, 1.0)

    return OutcomeRates(group, int(known.sum()), share(True, True), share(True, False), share(False, True), share(False, False))
