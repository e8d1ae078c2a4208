"""Whether successes became rarer, asked after every outcome, with a rate of false alarms that is stated beforehand.

A detector of Shiryaev and Roberts' kind made of e-values (an e-detector, Shin, Ramdas and Rinaldo, 2023): for each moment at which a change may have
come there is a bet that it did, begun then with one unit of stake; the alarm is given when all bets together are worth 1 / rate. Without a change no
bet gains on average, so after n outcomes all of them are worth n at most on average, and an alarm among n outcomes has probability n * rate at most,
and false alarms come once in 1 / rate outcomes at most on average, also where the detector begins again after each.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

RATE = 1e-5
"""False alarms an outcome, at most: one in a hundred runs of 1,000 decisions."""

ODDS = np.array([1 / 8, 1 / 4, 1 / 2])
"""By what the odds of success may have been multiplied."""

WEIGHT = 20.0
"""Outcomes that what is expected after a change is worth, at most, against those that came."""

STRIDE = 4
"""A bet begins at every so manieth outcome, with so many units."""

MOST = 256
"""Bets at once; of more the least promising are given up, which loses what they are worth."""


@dataclass(frozen=True)
class Fall:
    """A change for the worse.

    Attributes:
        since: number of the first outcome after it, from 0.
        before, after: rates of success.
    """

    since: int
    before: float
    after: float


class FallDetector:
    """Streams of successes and failures, each outcome of a stratum (such as a task) with a rate of its own.

    Unchanged means: in each stratum outcomes are independent of one another and of how many of which stratum come when, with one rate. Rates are
    unknown; a bet that a change came at some moment wins by the ratio of two predictions of each outcome since, both of Beta distributions that begin
    uniform: without the change, from all outcomes of the stratum; with it, from those before it with the odds of success lowered, corrected by those
    after it, and never above the rate before. Over rates that are uniform a priori a bet has an expected value of exactly 1; at fixed rates it is
    simulated (`tests/test_change.py`).

    Args:
        strata: number of them.
        streams: how many, all of as many outcomes.
        sums, counts: (streams, strata) successes and outcomes known beforehand.
    """

    def __init__(self, strata: int, streams: int = 1, sums: Array | None = None, counts: Array | None = None) -> None:
        self.sums = np.zeros((streams, strata)) if sums is None else sums.copy()
        self.counts = np.zeros((streams, strata)) if counts is None else counts.copy()
        self._seen = 0
        self._logs = np.zeros((streams, 0, len(ODDS)))
        self._then = np.zeros((2, streams, 0, strata))  # successes and outcomes when each bet began
        self._began = np.zeros((streams, 0), np.int64)

    def see(self, strata: ArrayLike, successes: ArrayLike) -> Array:
        """Take one more outcome of each stream into account. Returns what all bets are worth, as a logarithm, (streams,).

        Args:
            strata: (streams,) number of each outcome's stratum.
            successes: (streams,) truth values.
        """
        rows, stratum, won = np.arange(len(self.sums)), np.atleast_1d(np.asarray(strata, np.int64)), np.atleast_1d(np.asarray(successes, bool))
        if self._seen % STRIDE == 0 or not self._logs.shape[1]:
            self._begin()
        self._seen += 1
        total, count = self.sums[rows, stratum], self.counts[rows, stratum]
        usual = ((total + 1.0) / (count + 2.0))[:, None, None]
        changed = _changed(self._then[0][rows, :, stratum], self._then[1][rows, :, stratum], total[:, None], count[:, None], usual)
        self._logs += np.where(won[:, None, None], np.log(changed / usual), np.log((1.0 - changed) / (1.0 - usual)))
        self.sums[rows, stratum] += won
        self.counts[rows, stratum] += 1.0
        highest = self._logs.max(axis=(1, 2))
        worth = np.exp(self._logs - highest[:, None, None]).mean(axis=2).sum(axis=1)
        return np.asarray(highest + np.log(STRIDE * worth), np.float64)

    def likeliest(self, stream: int = 0) -> Fall:
        """Where the change was, by the bet that is worth most."""
        best = int(np.logaddexp.reduce(self._logs[stream], axis=1).argmax())
        before, tried = (float(own[stream, best].sum()) for own in self._then)
        after, later = float(self.sums[stream].sum()) - before, float(self.counts[stream].sum()) - tried
        return Fall(int(self._began[stream, best]), before / max(tried, 1.0), after / max(later, 1.0))

    def after(self, stream: int = 0) -> "FallDetector":
        """A detector of one stream that knows what came since the likeliest change, and looks for the next."""
        best = int(np.logaddexp.reduce(self._logs[stream], axis=1).argmax())
        sums, counts = (own[stream] - then[stream, best] for own, then in zip((self.sums, self.counts), self._then, strict=True))
        found = FallDetector(self.sums.shape[1], 1, sums[None], counts[None])
        found._seen = self._seen  # outcomes go on being numbered
        return found

    def _begin(self) -> None:
        """One more bet in each stream."""
        streams = len(self.sums)
        self._logs = np.concatenate([self._logs, np.zeros((streams, 1, len(ODDS)))], axis=1)
        self._then = np.concatenate([self._then, np.stack([self.sums, self.counts])[:, :, None]], axis=2)
        self._began = np.concatenate([self._began, np.full((streams, 1), self._seen)], axis=1)
        if self._logs.shape[1] > MOST:
            worth = self._logs.max(axis=2)
            worth[:, -1] = np.inf  # the newest stays
            kept = np.sort(np.argpartition(-worth, MOST - 1, axis=1)[:, :MOST], axis=1)
            rows = np.arange(streams)[:, None]
            self._logs, self._then, self._began = self._logs[rows, kept], self._then[:, rows, kept], self._began[rows, kept]


def _changed(sums: Array, counts: Array, total: Array, count: Array, usual: Array) -> Array:
    """Probability of success after each change, (streams, bets, odds).

    Args:
        sums, counts: (streams, bets) successes and outcomes of the stratum before the change.
        total, count: (streams, 1) of all of them.
        usual: (streams, 1, 1) probability without a change; taken where nothing was seen before.
    """
    before = ((sums + 1.0) / (counts + 2.0))[:, :, None]
    lowered = before * ODDS / (1.0 - before + before * ODDS)
    weight = np.minimum(counts, WEIGHT)[:, :, None]
    found = (1.0 + weight * lowered + (total - sums)[:, :, None]) / (2.0 + weight + (count - counts)[:, :, None])
    return np.asarray(np.where(counts[:, :, None] > 0.0, np.minimum(found, before), usual), np.float64)
