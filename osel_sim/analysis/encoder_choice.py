"""Which of several encoders tells most about rewards."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import cross_fit
from osel_sim.analysis.log import Array, LoggedOutcomes, read_log
from osel_sim.analysis.routers import context_routers
from osel_sim.context.cache import ContextCache
from osel_sim.selection.reward import RewardWeights

AUTO = "auto"
"""What stands for the choice among encoders."""


@dataclass(frozen=True)
class EncoderChoice:
    """Which encoder it is, and why.

    Attributes:
        encoder: identity of the one chosen.
        instances: how many of the choosing half it was chosen on.
        gains: identity -> reward that a router on its contexts has over the best single policy, and the standard error; the usual one first.
    """

    encoder: str
    instances: int
    gains: dict[str, tuple[float, float]]

    def __str__(self) -> str:
        """In one sentence."""
        if len(self.gains) < 2:
            return f"encoder {self.encoder}: the only one to choose from"
        usual = next(iter(self.gains))
        said = ", ".join(f"{name} {gain:+.4f} ± {error:.4f}" for name, (gain, error) in self.gains.items())
        why = "none is ahead of it by more than the error" if self.encoder == usual else f"ahead of {usual} by more than the error"
        return f"encoder {self.encoder}, {why}: over the best single policy a router gains on {self.instances} instances of the choosing half {said}"


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
    part = np.array([bool(hashlib.sha256(log.keys[row].encode()).digest()[3] & 1) for row in rows], bool)
    if len(contexts) < 2 or part.all() or not part.any():
        return EncoderChoice(next(iter(contexts)), len(rows), dict.fromkeys(contexts, (0.0, 0.0)))
    means = means[rows]
    single = means[:, means.mean(axis=0).argmax()]
    received = {name: _received(table[rows], means, part) for name, table in contexts.items()}
    usual = next(iter(received))
    best = max(received, key=lambda name: float(received[name].sum()))
    ahead = all(_mean(received[best] - other)[0] > _mean(received[best] - other)[1] for other in (received[usual], single))
    gains = {name: _mean(values - single) for name, values in received.items()}
    return EncoderChoice(best if ahead else usual, len(rows), gains)


def _received(contexts: NDArray[np.float32], means: Array, part: NDArray[np.bool_]) -> Array:
    """Reward (n,) of the best router on these contexts."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):  # the last bits of a matrix product depend on the number of threads
        tried = [cross_fit(part, lambda by, on, router=router: means[on, router(by, on)]) for router in context_routers(contexts, means).values()]  # type: ignore[misc]
    return np.asarray(max(tried, key=lambda values: float(values.sum())), np.float64)


def _mean(values: Array) -> tuple[float, float]:
    """With its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.inf
