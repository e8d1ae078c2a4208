"""Means over units that were drawn independently, such as instances, of values of which a unit has several that go together."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.statistics.intervals import Interval

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UnitMean:
    """A mean of all values, and how far it would move if other units had been drawn.

    Attributes:
        mean: the mean of all values.
        error: its standard error; infinite of a single unit.
        units: how many there are.
        rare: how far something that no unit has shown can move the mean (`unit_mean`).
    """

    mean: float
    error: float
    units: int
    rare: float = 0.0

    def half(self, tail: float) -> float:
        """How far the mean may lie from the truth to one side, wrong with probability `tail`: Student's t, and what is rare."""
        if self.units < 2:
            return math.inf
        from scipy.special import stdtrit  # scipy.stats has it too, and takes a second to import

        # What happens with probability p has not happened in n units with probability (1 - p)^n: p is below log(1 / tail) / n (the rule of three).
        return math.hypot(-float(stdtrit(self.units - 1, tail)) * self.error, self.rare * -math.log(tail) / self.units)

    def interval(self, confidence: float = 0.95) -> Interval:
        """Two-sided."""
        half = self.half((1.0 - confidence) / 2.0)
        return self.mean - half, self.mean + half


def unit_mean(sums: ArrayLike, counts: ArrayLike, learned: ArrayLike = 0.0, rare: float = 0.0) -> UnitMean:
    """Mean of all values of all units, with its standard error over units (that of a ratio: units have different numbers of values).

    Args:
        sums: (U,) sum of each unit's values.
        counts: (U,) how many values it has; units without any do not count.
        learned: (U,) what the unit changed in other units' sums, where values come from something that learned from it.
        rare: values differ by so much at most; widens the interval where few units were seen, so that values that were all equal do not make it
            vanish. 0 leaves that out.

    Raises:
        UsageError: no values.
    """
    number = np.asarray(counts, np.float64)
    kept = number > 0.0
    if not kept.any():
        raise UsageError("a mean over units needs at least one value")
    number, total = number[kept], np.asarray(sums, np.float64)[kept]
    mean, units = float(total.sum() / number.sum()), int(kept.sum())
    if units < 2:
        return UnitMean(mean, math.inf, units, rare)
    influence = total - mean * number + np.broadcast_to(np.asarray(learned, np.float64), kept.shape)[kept]
    return UnitMean(mean, math.sqrt(float((influence**2).sum()) * units / (units - 1)) / float(number.sum()), units, rare)
