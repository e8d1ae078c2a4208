"""What the best could have been on a log: four oracles, never mixed up, and the best single policy.

Each says what a chooser would receive on every instance, so that it can be averaged over just the instances that a selector was shown.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import Rows, cross_fit
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.remembered import Remembered
from osel_sim.analysis.routers import BY_TEXT, MODELS, SHRINK, SINGLE, TEXT, Router, group_numbers, routers
from osel_sim.core.errors import DataError
from osel_sim.selection.reward import RewardWeights

FOLDS = 5
"""Parts of a log, on all but one of which a model learns what its ceiling is (`osel_sim.analysis.verdict`)."""


@dataclass(frozen=True)
class Oracles:
    """N instances, P policies.

    Attributes:
        best_single, worst_single: columns of the policies with the highest and the lowest mean reward over all instances.
        expected: (N,) reward of the policy that was best on the same instance in other repeats, an estimate where it has none; None without repeats.
        expected_gains: (N,) what it has over `predictable` on each of the instances with repeats, NaN on others; the mean of `expected` is as sure as
            theirs.
        predictable: (N,) reward of the policy that a supervised router, trained on *other* instances, names.
        router: which one (`osel_sim.analysis.routers`), for each half of the instances (`first`, `second`) it was scored on.
        routed: name of every router that was tried -> (N,) reward of the policy it names, learned on the half (or all parts) it is not in.
        per_task: column of the policy with the highest mean reward on each instance's task, (N,).
    """

    best_single: int
    worst_single: int
    expected: Array | None
    expected_gains: Array
    predictable: Array
    router: dict[str, str]
    routed: dict[str, Array]
    per_task: NDArray[np.int64]

    @property
    def learnable(self) -> str:
        """The oracle that bounds what can be learned: `expected` where there is one, else `predictable`."""
        return "predictable" if self.expected is None else "expected"


_remembered = Remembered[Oracles]()


def oracles(log: LoggedOutcomes, weights: RewardWeights) -> Oracles:
    """Compute them over complete instances (`osel_sim.analysis.streams.complete_instances`)."""
    return _remembered(log, weights, lambda: _oracles(log, weights))


def _oracles(log: LoggedOutcomes, weights: RewardWeights) -> Oracles:
    rewards = log.rewards(weights)
    means = mean_over_repeats(rewards)
    if not len(means) or not np.isfinite(means).all():
        raise DataError(f"{log.source}: oracles need an outcome of every policy on every instance")
    predictable, router, routed = predictable_oracle(log, means)
    overall = means.mean(axis=0)
    expected, gains = expected_oracle(rewards, predictable) or (None, np.full(len(means), np.nan))
    return Oracles(int(overall.argmax()), int(overall.argmin()), expected, gains, predictable, router, routed, per_task(log, means))


def expected_oracle(rewards: Array, reference: Array) -> tuple[Array, Array] | None:
    """Best policy by its mean over one half of an instance's repeats, scored by its mean over the other half; mean of both ways round.

    Chosen and scored on the same outcomes, luck would count as foresight. An instance on which some policy has a single repeat only cannot be split:
    it gets the reference and, on top, the mean gain over the reference of those that can be, which have to be a fair sample of all. That is the
    difference estimator of survey sampling (Cochran, Sampling Techniques, 1977, chapter 7): without bias whatever the reference, and the less it
    depends on which instances were repeated, the nearer the reference comes to the oracle.

    Args:
        rewards: (N, P, R), NaN where there is no outcome.
        reference: (N,) reward of some other way to choose on every instance, such as `predictable_oracle`.

    Returns:
        reward on every instance, (N,), and the gains over the reference of the instances that can be split, (N,), NaN of others; None if none can.
    """
    known = np.isfinite(rewards)
    number = np.cumsum(known, axis=2) - 1  # the how-manieth valid repeat each is
    first, second = (mean_over_repeats(np.where(known & (number % 2 == parity), rewards, np.nan)) for parity in (0, 1))
    splits = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if not splits.any():
        return None
    rows = np.flatnonzero(splits)
    one = second[rows, first[rows].argmax(axis=1)]
    other = first[rows, second[rows].argmax(axis=1)]
    gains = (one + other) / 2.0 - reference[rows]
    value = reference + gains.mean()
    value[rows] = reference[rows] + gains
    everywhere = np.full(len(reference), np.nan)
    everywhere[rows] = gains
    return value, everywhere


def predictable_oracle(log: LoggedOutcomes, means: Array) -> tuple[Array, dict[str, str], dict[str, Array]]:
    """Policy that a supervised router names for an instance, learned on one half of the instances and scored on the other, both ways round.

    Which of the routers it is (one policy for all, the best of a group, a model of the contexts: `osel_sim.analysis.routers`) is chosen on the
    learning half as well (from one part of it to the other, both ways round): nothing scored had a say. One policy for all it is unless another
    was ahead by more than the standard error of the difference.
    The halves are other ones than the log's own, so that a log of which only one of those is replayed still has both.

    Args:
        means: (N, P) mean rewards.

    Returns:
        its reward on every instance, (N,), the router used for each half, and the rewards (N,) of every router that routes at all, of the models
        also those learned on `FOLDS - 1` of `FOLDS` parts: what half of a log does not teach yet, more of it may.
    """
    from threadpoolctl import threadpool_limits

    found = routers(log, means)
    half, quarter = (np.array([bool(hashlib.sha256(key.encode()).digest()[byte] & 1) for key in log.keys], bool) for byte in (1, 2))
    used: list[str] = []

    def decide(by: Rows, on: Rows) -> Array:
        parts = [(by & part, by & ~part) for part in (quarter, ~quarter)]
        tried = {name: np.concatenate([_received(means, router, *part) for part in parts]) for name, router in found.items()}
        best = max(tried, key=lambda name: float(tried[name].sum()))  # the first, which knows least, where several are equal
        if not _is_ahead(tried[best] - tried[SINGLE]):
            best = SINGLE
        elif BY_TEXT in found and not _is_ahead(tried[best] - tried[BY_TEXT]):
            best = BY_TEXT  # with all rows of a text it is better than here, with a quarter of them
        used.append(best)
        return np.stack([_received(means, router, by, on) for router in found.values()], axis=1)

    with threadpool_limits(1):  # the last bits of a matrix product depend on the number of threads
        table = cross_fit(~half, decide)
        more = _by_most_others(log, means, {name: found[name] for name in MODELS})
    routed = dict(zip(found, table.T, strict=True))
    if BY_TEXT in routed:
        routed[BY_TEXT] = _by_other_rows_of_the_text(log, means)
    value = np.where(half, routed[used[1]], routed[used[0]])
    routed |= more
    return value, dict(zip(("first", "second"), used, strict=True)), {name: own for name, own in routed.items() if name != SINGLE}


def _is_ahead(differences: Array) -> bool:
    """By more than the standard error."""
    return bool(len(differences) and differences.sum() > differences.std() * np.sqrt(len(differences)))


def _by_other_rows_of_the_text(log: LoggedOutcomes, means: Array) -> Array:
    """Reward on every instance, (N,), of the policy that is best on all others of the same text.

    A selector that reads texts learns of one from all of its rows that come before. Half of the log has half of them, and what it says of a text that
    stands in ten rows would lie below what the selector comes to.
    """
    groups = group_numbers([log.labels(TEXT)], len(log))
    others = (means.sum(axis=0) - means) / max(len(log) - 1, 1)
    sums = np.stack([np.bincount(groups, weights=column) for column in means.T], axis=1)
    beliefs = (sums[groups] - means + SHRINK * others) / (np.bincount(groups)[groups] - 1.0 + SHRINK)[:, None]
    return np.asarray(means[np.arange(len(log)), beliefs.argmax(axis=1)], np.float64)


def _by_most_others(log: LoggedOutcomes, means: Array, models: Mapping[str, Router]) -> dict[str, Array]:
    """Rewards (N,) of what each model names for an instance, learned on the other parts of the log."""
    part = np.array([hashlib.sha256(key.encode()).digest()[3] % FOLDS for key in log.keys])
    found = {f"{name}, learned on {FOLDS - 1} of {FOLDS} parts": np.zeros(len(log)) for name in models}
    for number in range(FOLDS):
        on = part == number
        for name, model in zip(found, models.values(), strict=True):
            found[name][on] = _received(means, model, ~on, on)
    return found


def _received(means: Array, router: Router, by: Rows, on: Rows) -> Array:
    """Rewards on the instances `on` of the policies that a router learned to choose from the instances `by`."""
    if not by.any() or not on.any():
        return means[on].mean(axis=1)
    return np.asarray(means[on, router(by, on)], np.float64)


def per_task(log: LoggedOutcomes, means: Array) -> NDArray[np.int64]:
    """Column of the policy with the highest mean reward on each instance's task, (N,); chosen and scored on the same outcomes."""
    groups = group_numbers([log.labels("task")], len(log))
    best = np.array([means[groups == group].mean(axis=0).argmax() for group in range(groups.max() + 1)], np.int64)
    return best[groups]
