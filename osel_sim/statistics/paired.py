"""Two columns measured on the same instances: which is higher, by how much, and how many instances it takes to tell.

An instance's value is its mean over repeats, so that instances are what is drawn independently. `differences` are (N,): the second column's value
minus the first's on each instance. Of successes they lie in [-1, 1], and are -1, 0 or 1 where no instance was repeated.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from osel_sim.core.errors import UsageError
from osel_sim.statistics.intervals import Interval

Array = NDArray[np.float64]

CAUTION = 10
"""So many instances speak beforehand for repeats being all alike: few instances say little of how much repeats are worth."""
DRAWS = 100_000
"""How often signs are drawn anew where the exact distribution is not at hand."""


def mcnemar_midp(gained: int, lost: int) -> float:
    """Two-sided exact conditional McNemar test with the mid-p correction (Fagerland, Lydersen and Laake, 2013).

    The exact test is needlessly cautious; mid-p counts half of the probability of what was seen, and keeps the error near its nominal level.

    Args:
        gained: instances that only the second solved, >= 0.
        lost: instances that only the first solved, >= 0.

    Raises:
        UsageError: a negative number.
    """
    if gained < 0 or lost < 0:
        raise UsageError(f"discordant pairs must be 0 or more, got {gained} and {lost}")
    from scipy.special import bdtr  # the binomial distribution; scipy.stats has it too, and takes a second to import

    fewer, discordant = min(gained, lost), gained + lost
    if discordant == 0:
        return 1.0
    # Both tails, less half of what was seen on either side: P(X <= fewer) + P(X < fewer).
    return min(1.0, float(bdtr(fewer, discordant, 0.5)) + (float(bdtr(fewer - 1, discordant, 0.5)) if fewer else 0.0))


def sign_flip_midp(differences: ArrayLike, seed: int = 0, draws: int = DRAWS) -> float:
    """Two-sided mid-p of the hypothesis that each difference is as likely to have the other sign.

    The same test as McNemar's, for instances with repeats, whose differences are fractions; where all are -1, 0 or 1 it is McNemar's, exactly.

    Args:
        differences: (N,), finite.
        seed: of the signs; the same seed gives the same p.

    Raises:
        UsageError: no differences, or one that is not finite.
    """
    values = _checked(differences)
    sizes, counts = np.unique(np.round(np.abs(values[values != 0.0]), 9), return_counts=True)
    if not sizes.size:
        return 1.0
    if sizes.tolist() == [1.0]:
        return mcnemar_midp(int((values > 0.0).sum()), int((values < 0.0).sum()))
    generator = np.random.default_rng(seed)
    # How many of the differences of one size are positive is binomial.
    sums = sum(size * (2.0 * generator.binomial(count, 0.5, draws) - count) for size, count in zip(sizes, counts, strict=True))
    seen, drawn = abs(float(values.sum())), np.abs(np.asarray(sums))
    equal = np.isclose(drawn, seen, rtol=0.0, atol=1e-7)
    return float(min(1.0, ((drawn > seen) & ~equal).mean() + 0.5 * equal.mean() + 1.0 / draws))


def score_interval(gained: float, lost: float, pairs: float, confidence: float = 0.95) -> Interval:
    """Tango's (1998) score interval of the difference (gained - lost) / pairs of two paired proportions.

    Holds its coverage where discordant pairs are few or none, and a normal interval has no width.

    Args:
        gained, lost: discordant pairs either way, >= 0; not whole where `pairs` is an effective number.
        pairs: > 0, at least gained + lost.
        confidence: in (0, 1).

    Raises:
        UsageError: a number out of range.
    """
    if gained < 0 or lost < 0 or pairs <= 0 or gained + lost > pairs * (1.0 + 1e-9):
        raise UsageError(f"discordant pairs must be 0 or more and {pairs} together at most, got {gained} and {lost}")
    z = _quantile(confidence)
    estimate = (gained - lost) / pairs

    def statistic(difference: float) -> float:
        """How many standard errors the estimate lies above a difference, the standard error being the one under that difference."""
        linear = (2.0 * pairs - gained + lost) * difference - gained - lost
        root = max(linear**2 + 8.0 * pairs * lost * difference * (1.0 - difference), 0.0)
        share = max((math.sqrt(root) - linear) / (4.0 * pairs), 0.0)
        variance = max(pairs * (2.0 * share + difference * (1.0 - difference)), 1e-300)
        return (gained - lost - pairs * difference) / math.sqrt(variance)

    return _crossing(statistic, -1.0, estimate, z), -_crossing(lambda value: -statistic(-value), -1.0, -estimate, z)


def success_interval(differences: ArrayLike, confidence: float = 0.95, most: float = math.inf) -> Interval:
    """Score interval of the mean difference of success, repeats or not.

    Differences of instances with repeats are fractions, and vary less. They count as so many pairs without repeats as would make the mean vary as
    they do: at least the number of instances, at most `most`. Without repeats this is Tango's interval.

    Args:
        differences: (N,) in [-1, 1].
        most: number of pairs of repeats.

    Raises:
        UsageError: no differences, or one out of range.
    """
    values = _checked(differences)
    if np.abs(values).max() > 1.0 + 1e-9:
        raise UsageError(f"differences of success must lie in [-1, 1], got {values[np.abs(values).argmax()]}")
    scale = _pairs_an_instance(values, most)
    gained, lost = float(np.maximum(values, 0.0).sum()), float(np.maximum(-values, 0.0).sum())
    return score_interval(gained * scale, lost * scale, len(values) * scale, confidence)


def mean_interval(differences: ArrayLike, confidence: float = 0.95) -> Interval | None:
    """Student's interval of the mean of paired differences; None of fewer than two or of equal ones, which say nothing of how they vary."""
    values = _checked(differences)
    if len(values) < 2 or values.min() == values.max():
        return None
    from scipy.special import stdtrit

    half = float(stdtrit(len(values) - 1, 0.5 + confidence / 2.0)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return float(values.mean()) - half, float(values.mean()) + half


def holm(probabilities: Sequence[float]) -> list[float]:
    """Holm's correction: each p as if it were the only one, so that some true hypothesis is refused with the nominal error at most (Holm, 1979)."""
    order = sorted(range(len(probabilities)), key=lambda index: probabilities[index])
    adjusted, highest = [0.0] * len(probabilities), 0.0
    for rank, index in enumerate(order):
        highest = max(highest, min(1.0, (len(probabilities) - rank) * probabilities[index]))
        adjusted[index] = highest
    return adjusted


def letters(names: Sequence[str], different: Sequence[tuple[str, str]]) -> dict[str, str]:
    """Compact letter display (Piepho, 2004): two names share a letter if and only if they were not told apart.

    Args:
        names: the best first, who gets `a`.
        different: pairs that were told apart.
    """
    columns = [set(names)]
    for one, other in different:
        split = [part for column in columns if {one, other} <= column for part in (column - {one}, column - {other})]
        columns = [column for column in columns if not {one, other} <= column] + split
        columns = [
            column
            for index, column in enumerate(columns)
            if not any(column < more or (column == more and index > at) for at, more in enumerate(columns))
        ]
    columns.sort(key=lambda column: sorted(names.index(name) for name in column))
    return {name: "".join(_letter(index) for index, column in enumerate(columns) if name in column) for name in names}


@dataclass(frozen=True)
class Discordance:
    """How the difference of success varies from instance to instance: what sample sizes are planned by.

    Attributes:
        share: of the pairs that are discordant, in (0, 1): with half a pair more either way, so that none in a few does not stand for none at all
            (Agresti and Min, 2005).
        scale: how many pairs without repeats an instance is worth, >= 1.
    """

    share: float
    scale: float

    @classmethod
    def of(cls, differences: ArrayLike, most: float = math.inf) -> "Discordance":
        """As a sample (N,) shows it; `most` as in `success_interval`."""
        values = _checked(differences)
        scale = _pairs_an_instance(values, most)
        return cls((float(np.abs(values).sum()) * scale + 1.0) / (len(values) * scale + 2.0), scale)

    def instances(self, difference: float, power: float = 0.8, error: float = 0.05) -> int:
        """Instances needed to find a difference of success with McNemar's test (Connor, 1987).

        Args:
            difference: to find, other than 0, in [-1, 1].
            power: probability to find it, in (0, 1).
            error: two-sided, in (0, 1).

        Raises:
            UsageError: a number out of range.
        """
        size = abs(difference)
        if not 0.0 < size <= 1.0 or not 0.0 < power < 1.0:
            raise UsageError(f"a difference in (0, 1] and a power in (0, 1) can be planned for, got {difference} and {power}")
        share = max(self.share, size)  # a difference needs at least that many discordant pairs
        wanted = _quantile(1.0 - error) * math.sqrt(share) + NormalDist().inv_cdf(power) * math.sqrt(share - size * size)
        return math.ceil((wanted / size) ** 2 / self.scale)


def _pairs_an_instance(values: Array, most: float) -> float:
    """Pairs without repeats that vary as much in the mean as one instance does."""
    share, mean, spread = float(np.abs(values).mean()), float(values.mean()), float(values.var(ddof=1)) if len(values) > 1 else 0.0
    if spread <= 0.0:
        return 1.0
    # A sample of whole differences has this spread over (N - 1) pairs; it must come to 1 exactly.
    whole = (share - mean * mean) * len(values) / (len(values) - 1)
    scale = float(np.clip(whole / spread, 1.0, max(most / len(values), 1.0)))
    return (scale * len(values) + CAUTION) / (len(values) + CAUTION)


def _crossing(statistic: Callable[[float], float], low: float, high: float, level: float) -> float:
    """Where a statistic that falls from `low` to `high` comes down to a level; `low` if it never exceeds it."""
    if statistic(low + 1e-12) <= level:
        return low
    for _ in range(80):
        middle = (low + high) / 2.0
        low, high = (middle, high) if statistic(middle) > level else (low, middle)
    return (low + high) / 2.0


def _letter(index: int) -> str:
    """a to z, then a1, b1 ..."""
    return chr(ord("a") + index % 26) + (str(index // 26) if index >= 26 else "")


def _quantile(confidence: float) -> float:
    if not 0.0 < confidence < 1.0:
        raise UsageError(f"confidence must lie strictly between 0 and 1, got {confidence}")
    return NormalDist().inv_cdf(0.5 + confidence / 2.0)


def _checked(differences: ArrayLike) -> Array:
    values = np.asarray(differences, np.float64).ravel()
    if not values.size or not np.isfinite(values).all():
        raise UsageError(f"{values.size} differences: at least one is needed, all finite")
    return values
