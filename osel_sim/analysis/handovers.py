"""What monitors make of a table of moments: who hands over when, and what comes of it, exactly.

A monitor's handovers are probabilities (N, P, R, M, P): that the episode of an instance, first policy and repeat passes at a decision point to
another policy. Those of one episode sum to 1 at most; what is left is the probability that the first policy drives to the end. So a monitor that
leaves nothing to chance, a random one and a mixture of both are measured alike, without drawing anything.

Episodes with one handoff at most are all that the table has. What a monitor would do after that is not known, and it is not asked.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, mean_over_repeats
from osel_sim.analysis.moment_log import KEPT, MomentLog, rewards_of
from osel_sim.selection.reward import RewardWeights

Handovers = NDArray[np.float64]
"""Probabilities (N, P, R, M, P), as above."""


def never(log: MomentLog) -> Handovers:
    """Nobody hands over."""
    return np.zeros((*log.there.shape, len(log.policies)))


def blind(log: MomentLog, call: int, to: int) -> Handovers:
    """Hand over before a call, whoever drives and whatever is to be seen.

    Args:
        call: one of `log.calls`.
        to: column of the policy that takes over; its own episodes go on.
    """
    result = never(log)
    at = log.calls.index(call)
    result[..., at, to] = log.there[..., at]
    result[:, to, :, at, to] = 0.0
    return result


def by_chance(log: MomentLog, chance: float, to: Sequence[int]) -> Handovers:
    """Hand over at each decision point with a probability, to one of these policies with equal chances.

    Args:
        to: columns.
    """
    result = never(log)
    for first in range(len(log.policies)):
        others = [column for column in to if column != first]
        left = np.ones(log.there.shape[:1] + log.there.shape[2:3])
        for at in range(len(log.calls)) if others else ():
            passes = left * chance * log.there[:, first, :, at]
            for column in others:
                result[:, first, :, at, column] = passes / len(others)
            left = left - passes
    return result


def first_turns(log: MomentLog, turns: NDArray[np.int64]) -> Handovers:
    """Of what a monitor says at each decision point: the first handover of each episode.

    Args:
        turns: (N, P, R, M), column of the policy that is to drive on; the driver's own, or anything where there is no point, hands over to nobody.
    """
    result = never(log)
    passes = log.there & (turns != driving_on(log))
    first = passes & (np.cumsum(passes, axis=3) == 1)
    where = np.nonzero(first)
    result[(*where, turns[where])] = 1.0
    return result


def outcomes(log: MomentLog, handovers: Handovers, measures: Sequence[str] = KEPT) -> dict[str, Array]:
    """What is expected of each episode: measure -> (N, P, R); NaN where something that may happen has no outcome."""
    stays = 1.0 - handovers.sum(axis=(3, 4))
    return {name: _expected(log.alone[name], log.ways[name], stays, handovers) for name in measures}


def reward_of(log: MomentLog, handovers: Handovers, weights: RewardWeights) -> Array:
    """Reward expected of each episode, (N, P, R); NaN as in `outcomes`."""
    stays = 1.0 - handovers.sum(axis=(3, 4))
    return _expected(rewards_of(log.alone, weights), log.rewards(weights), stays, handovers)


def recovered_and_harmed(log: MomentLog, handovers: Handovers) -> tuple[Array, Array, Array, Array]:
    """Of each episode, (N, P, R) each: does the first policy alone lose it, and how likely is it won then; does it win, and how likely is it lost?"""
    alone, then = log.alone["success"], outcomes(log, handovers)["success"]
    known = np.isfinite(alone) & np.isfinite(then)
    lost, won = np.where(known, 1.0 - alone, np.nan), np.where(known, alone, np.nan)
    return lost, lost * then, won, won * (1.0 - then)


def with_starts(values: Array, share: Array) -> Array:
    """What each instance comes to, (N,), over its repeats and first policies; NaN where something that may happen has no outcome.

    Args:
        values: (N, P, R), of each episode.
        share: (N, P), how likely each first policy is chosen.
    """
    return np.asarray(np.where(share > 0.0, share * mean_over_repeats(values), 0.0).sum(axis=1), np.float64)


def driving_on(log: MomentLog) -> NDArray[np.int64]:
    """Turns in which nobody hands over, as `first_turns` takes them: the driver at each decision point, (N, P, R, M)."""
    return np.broadcast_to(np.arange(len(log.policies))[None, :, None, None], log.there.shape).copy()


def _expected(alone: Array, ways: Array, stays: Array, handovers: Handovers) -> Array:
    """Expected value; what cannot happen need not be known."""
    going_on: Any = np.where(stays > 1e-12, stays * alone, 0.0)
    passing = np.where(handovers > 0.0, handovers * ways, 0.0)
    return np.asarray(going_on + passing.sum(axis=(3, 4)), np.float64)
