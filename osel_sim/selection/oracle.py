"""What the best could have been, from a table of the rewards of every policy on every instance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import DataError


@dataclass(frozen=True)
class Comparison:
    """Mean rewards over the same instances.

    Attributes:
        instances: how many: those on which every policy has a reward.
        received: of what was chosen.
        best_single: column of the policy with the best mean reward (the first, where several share it).
        best_single_reward: of that policy.
        hindsight_oracle: of the best policy of each instance, known only afterwards: optimistic, and not learnable where outcomes are noisy.
        regret: hindsight oracle minus received, per decision, >= 0.
    """

    instances: int
    received: float
    best_single: int
    best_single_reward: float
    hindsight_oracle: float
    regret: float


def compare(rewards: ArrayLike, chosen: ArrayLike) -> Comparison:
    """Set what was chosen against the best single policy and the hindsight oracle, on the instances on which every policy has a reward.

    Args:
        rewards: (instances, policies); NaN where there is no valid outcome (never a failure: the instance is left out, and the count says so).
        chosen: (instances,) column chosen for each.

    Raises:
        DataError: no instance has a reward of every policy.
    """
    table, complete = _table(rewards)
    table, columns = table[complete], np.asarray(chosen, np.int64)[complete]
    means = table.mean(axis=0)
    received = float(table[np.arange(len(table)), columns].mean())
    oracle = float(table.max(axis=1).mean())
    return Comparison(len(table), received, int(means.argmax()), float(means.max()), oracle, oracle - received)


def _table(rewards: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    table = np.asarray(rewards, np.float64)
    if table.ndim != 2 or table.shape[1] == 0:
        raise DataError(f"rewards must be a table (instances, policies), got shape {table.shape}")
    complete = np.isfinite(table).all(axis=1)
    if not complete.any():
        raise DataError(f"none of {len(table)} instances has a reward of every policy")
    return table, complete
