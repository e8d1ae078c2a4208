"""When policies became better or worse: a change of what a regression leaves unexplained."""

import math

import numpy as np
from numpy.typing import NDArray

from osel_sim.selection.regression import NOISE_WEIGHT

Array = NDArray[np.float64]

PIECES = 16
"""A change is looked for at the ends of so many equal pieces of what was seen."""

LATE = (8, 16, 32, 64, 128)
"""And so many decisions before the last, where that is finer: a change is to be seen soon after it."""


FARTHEST = 2.0
"""What is unexplained counts at most so many deviations. The first failure of a policy that fails once in a hundred is ten of them from the mean, and
would by itself be a change if it were Gaussian; where success is less sure than 0.8 no failure is as far."""


def change_point(left: Array, chosen: NDArray[np.int64], policies: int, noise: float, alarm: float) -> int:
    """How many decisions came before a change, for which the evidence exceeds `alarm`; 0 where it does not.

    What a regression leaves unexplained has mean 0 for every policy, at all times, however choices changed while it was learned. Compared is that
    with means of their own before and after a change (Gaussian, of prior variance 1 relative to the noise), wherever it was.

    Args:
        left: (n,) what is unexplained, n >= `PIECES`.
        chosen: (n,) columns of the policies.
        policies: number of them.
        noise: its variance by the regression.
        alarm: what was seen must be so many times as probable with a change as without.
    """
    late = len(chosen) - np.array([step for step in LATE if step < len(chosen) // 8], np.int64)
    starts = np.unique(np.concatenate([len(chosen) * np.arange(1, PIECES) // PIECES, late]))
    # A success rate near 1 varies less than others: a policy is measured by its own noise, where that is more than the others'.
    tried = np.bincount(chosen, minlength=policies)
    own = (NOISE_WEIGHT * noise + np.bincount(chosen, left**2, policies)) / (NOISE_WEIGHT + tried)
    scaled = np.clip(left / np.sqrt(np.maximum(own, noise))[chosen], -FARTHEST, FARTHEST)
    piece = np.searchsorted(starts, np.arange(len(chosen)), side="right")
    counts, sums = np.zeros((2, len(starts) + 1, policies))
    np.add.at(counts, (piece, chosen), 1.0)
    np.add.at(sums, (piece, chosen), scaled)
    counts, sums = counts.cumsum(axis=0), sums.cumsum(axis=0)
    before, after = _evidence(counts[:-1], sums[:-1]), _evidence(counts[-1] - counts[:-1], sums[-1] - sums[:-1])
    ahead = before + after - _evidence(counts[-1:], sums[-1:])
    most = float(ahead.max())
    return int(starts[ahead.argmax()]) if most + math.log(np.exp(ahead - most).mean()) > math.log(alarm) else 0


def _evidence(counts: Array, sums: Array) -> Array:
    """Log probability (n,) of numbers of variance 1 and means of prior variance 1, over that with means of 0, from counts and sums (n, P)."""
    return np.asarray((0.5 * (sums**2 / (counts + 1.0) - np.log(counts + 1.0))).sum(axis=1), np.float64)
