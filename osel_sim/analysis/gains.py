"""How much one way of choosing has over another, and whether that is more than chance. Judged over units: others could have been drawn."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array
from osel_sim.analysis.streamed import Units, over_units
from osel_sim.statistics.intervals import Interval

ERROR = 0.05
"""Probability, at most, of seeing a difference where there is none."""

ROUNDING = 1e-12
"""Two means of the same rewards may differ by so much."""


@dataclass(frozen=True)
class Gain:
    """Reward a decision, with its standard error over units."""

    mean: float
    error: float

    @property
    def interval(self) -> Interval:
        """At 95%."""
        half = _width(1) * self.error
        return self.mean - half, self.mean + half

    @property
    def ends(self) -> list[float] | None:
        """The interval for a file; None where it is unbounded, for want of instances."""
        return list(self.interval) if math.isfinite(self.error) else None

    def beyond_error(self, among: int = 1) -> bool:
        """Whether it is above zero. `among`: of so many gains that are looked at."""
        return self.mean > max(_width(among) * self.error, ROUNDING)


def gain_of(order: NDArray[np.int32], differences: Array, units: Units, off: float = 0.0) -> Gain:
    """Mean of differences in reward.

    Args:
        order: (S, T) instance of every decision.
        differences: (S, T).
        units: (N,) of the instances.
        off: standard error that the mean has besides.
    """
    found = over_units(differences, order, units)
    return Gain(0.0, math.inf) if found is None else Gain(found.mean, math.hypot(found.error, off))


def ahead_of(oracle: Array, selectors: Mapping[str, Array], order: NDArray[np.int32], units: Units, late: int, off: float = 0.0) -> str | None:
    """The selector furthest ahead of an oracle beyond the error, over the whole stream or from decision `late` on; None where none is.

    Args:
        oracle, selectors: rewards (S, T).
        order: (S, T) instance of every decision.
        units: (N,) of the instances.
        off: standard error of the oracle's mean besides that over units.
    """
    parts = (slice(None), slice(late, None))
    gains = [(gain_of(order[:, part], (own - oracle)[:, part], units, off), name) for name, own in selectors.items() for part in parts]
    ahead = [(gain.mean, name) for gain, name in gains if gain.beyond_error(len(gains))]
    return max(ahead)[1] if ahead else None


def _width(among: int) -> float:
    return NormalDist().inv_cdf(1.0 - ERROR / 2.0 / among)
