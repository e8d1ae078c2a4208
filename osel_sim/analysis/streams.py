"""In which order a replay shows a log's instances, and which repeat counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.core.errors import DataError, UsageError
from osel_sim.selection.reward import RewardWeights

_SALT = 0x05E1
"""Keeps the streams' random numbers apart from those of selectors of the same seed."""


@dataclass(frozen=True)
class LeftOut:
    """Instances that a replay cannot use, and why.

    Attributes:
        instances: how many lack a valid outcome of at least one policy.
        by_policy: policy -> on how many instances it has none.
        errors: episodes that ended in error, wherever they are.
    """

    instances: int
    by_policy: dict[str, int]
    errors: int


def complete_instances(log: LoggedOutcomes, weights: RewardWeights) -> tuple[LoggedOutcomes, LeftOut]:
    """Those instances on which every policy has at least one valid outcome; the only ones a replay can use.

    A missing outcome is nobody's failure, and a selector that chose it could be told nothing. Were such choices skipped, selectors would be compared
    on different instances. So an instance that lacks one is shown to no selector, and counted; where outcomes are missing for reasons that have to
    do with the instance, what is measured holds for the rest only.

    Raises:
        DataError: there is none.
    """
    known = np.isfinite(log.mean_rewards(weights))
    left_out = LeftOut(
        int((~known.all(axis=1)).sum()),
        {policy: int((~known[:, column]).sum()) for column, policy in enumerate(log.policies)},
        int(log.errors.sum()),
    )
    if not known.all(axis=1).any():
        counts = ", ".join(f"{policy} on {int(known[:, column].sum())}" for column, policy in enumerate(log.policies))
        raise DataError(f"{log.source}: none of {len(log)} instances has an outcome of every policy ({counts}); name some of them with --policies")
    return log.take(known.all(axis=1)), left_out


@dataclass(frozen=True)
class Streams:
    """S seeds, T decisions. See `osel_sim.formats.replay_result.Choices` for `order` and `repeats`."""

    order: NDArray[np.int32]
    repeats: NDArray[np.int16]

    def rewards(self, table: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
        """Rewards (T, P) of every policy in the stream of one seed (its position), of a table (N, P, R)."""
        return np.asarray(table[self.order[seed][:, None], np.arange(table.shape[1]), self.repeats[seed]], np.float64)


def draw_streams(rewards: NDArray[np.float64], seeds: Sequence[int], decisions: int | None = None) -> Streams:
    """A random order of the instances without replacement for every seed (paper, section V), and a random repeat for every instance and policy.

    All selectors see the same stream of a seed, so that differences between them are paired.

    Args:
        rewards: (N, P, R), NaN where a repeat is missing; every (instance, policy) has at least one.
        decisions: how many instances of each order to use; None: all.

    Raises:
        UsageError: more decisions than there are instances.
    """
    count = len(rewards) if decisions is None else decisions
    if count > len(rewards):
        raise UsageError(f"--decisions {count}: the log has {len(rewards)} instances with an outcome of every policy; give that many or fewer")
    known = np.isfinite(rewards)
    valid = known.sum(axis=2)
    first = np.argsort(~known, axis=2, kind="stable")  # the positions of valid repeats come first
    order, repeats = [], []
    for seed in seeds:
        generator = np.random.default_rng([_SALT, seed])
        rows = generator.permutation(len(rewards))[:count]
        number = np.minimum((generator.random(valid.shape) * valid).astype(np.int64), valid - 1)
        drawn = np.take_along_axis(first, number[:, :, None], axis=2)[:, :, 0]
        order.append(rows.astype(np.int32))
        repeats.append(drawn[rows].astype(np.int16))
    return Streams(np.stack(order), np.stack(repeats))
