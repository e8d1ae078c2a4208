"""Which of several encoders tells most about rewards."""

import hashlib
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import cross_fit_parts
from osel_sim.analysis.log import Array, LoggedOutcomes, read_log
from osel_sim.analysis.routers import context_routers
from osel_sim.context.cache import ContextCache
from osel_sim.formats.encoder_choice import AUTO as AUTO
from osel_sim.formats.encoder_choice import EncoderChoice as EncoderChoice
from osel_sim.selection.reward import RewardWeights


def with_best_encoder(log: LoggedOutcomes, weights: RewardWeights) -> tuple[LoggedOutcomes, EncoderChoice]:
    """A log with those of its contexts that predict rewards best, by the outcomes of its choosing half.

    Args:
        log: as it was read, with its usual contexts.
    """
    cache = ContextCache(log.source)
    contexts = {log.encoder: log.contexts}
    for name in cache.encoders():
        if all(cache.get(name, key) is not None for key in log.keys):
            contexts.setdefault(name, cache.table(name, log.keys))
    choice = choose_encoder(log, contexts, weights)
    return (log if choice.encoder == log.encoder else read_log(log.source, choice.encoder)), choice


def choose_encoder(log: LoggedOutcomes, contexts: Mapping[str, NDArray[np.float32]], weights: RewardWeights) -> EncoderChoice:
    """The encoder on whose contexts a router earns most: learned on one part of the choosing half, scored on the other, both ways round.

    It stays the first unless another is ahead of it, and of the best single policy, by more than the standard error: where no encoder tells
    anything, the choice changes nothing.

    Args:
        contexts: identity -> (N, D); the first is the usual one.
    """
    means = log.mean_rewards(weights)
    rows = np.flatnonzero(log.half("choose") & np.isfinite(means).all(axis=1))
    parts = np.array([hashlib.sha256(log.keys[row].encode()).digest()[3] & 1 for row in rows], np.int64)
    return best_encoder({name: table[rows] for name, table in contexts.items()}, means[rows], parts)


def best_encoder(contexts: Mapping[str, NDArray[np.float32]], means: Array, parts: NDArray[np.int64]) -> EncoderChoice:
    """The same, of rewards (N, P) of every policy on N instances, each part of which is scored by what was learned on the others.

    Args:
        contexts: identity -> (N, D); the first is the usual one.
        parts: (N,) number of the part that each instance is in.
    """
    if len(contexts) < 2 or len(set(parts.tolist())) < 2:
        return EncoderChoice(next(iter(contexts)), len(means), dict.fromkeys(contexts, (0.0, 0.0)))
    single = means[:, means.mean(axis=0).argmax()]
    received = {name: _received(table, means, parts) for name, table in contexts.items()}
    usual = next(iter(received))
    best = max(received, key=lambda name: float(received[name].sum()))
    ahead = all(_mean(received[best] - other)[0] > _mean(received[best] - other)[1] for other in (received[usual], single))
    gains = {name: _mean(values - single) for name, values in received.items()}
    return EncoderChoice(best if ahead else usual, len(means), gains)


def _received(contexts: NDArray[np.float32], means: Array, parts: NDArray[np.int64]) -> Array:
    """Reward (n,) of the best router on these contexts."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # the last bits of a matrix product depend on the number of threads
        routers = context_routers(contexts, means).values()
        tried = [cross_fit_parts(parts, lambda by, on, router=router: means[on, router(by, on)]) for router in routers]  # type: ignore[misc]
    return np.asarray(max(tried, key=lambda values: float(values.sum())), np.float64)


def _mean(values: Array) -> tuple[float, float]:
    """With its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.inf
