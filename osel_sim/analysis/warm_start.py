"""A warm start: outcomes of a log that a selector is shown before its first decision."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Selector
from osel_sim.selection.registry import learns_off_policy, selector_locations

_SALT = 0x3A2E
"""Keeps the order of what is shown apart from other random numbers of the same seed."""


@dataclass(frozen=True)
class WarmStart:
    """Outcomes of instances that are not decided on: contexts float32 (M, D), rewards (M, P, R), NaN where there is none."""

    contexts: NDArray[np.float32]
    rewards: NDArray[np.float64]


def check_can_start_warm(name: str) -> None:
    """Whether a selector may be shown outcomes of choices that it did not make.

    Raises:
        UsageError: it learns from its own choices only.
    """
    kind = name.partition(":")[0]
    if not learns_off_policy(kind):
        able = sorted(known for known in selector_locations() if known != "kernel_ucb" and learns_off_policy(known))
        raise UsageError(f"selector {kind!r} learns only from what it chose itself, so it cannot start warm; those that can: {', '.join(able)}")


def show(selector: Selector, warm_start: WarmStart, policies: Sequence[str], seed: int) -> int:
    """Let a selector learn from every outcome, in an order of the seed's, as if each had been chosen by chance. Returns how many there were.

    Args:
        policies: P names, in the order of the rewards.
    """
    chances = {policy: 1.0 / len(policies) for policy in policies}
    known = np.argwhere(np.isfinite(warm_start.rewards))
    for row, column, repeat in np.random.default_rng([_SALT, seed]).permutation(known):
        selector.update(warm_start.contexts[row], Choice(policies[column], chances), float(warm_start.rewards[row, column, repeat]))
    return len(known)
