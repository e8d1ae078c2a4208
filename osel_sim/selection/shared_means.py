"""Counts and mean rewards by policy that robots add up: what a selector without context has to share."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import State

Counts = NDArray[np.int64]
Means = NDArray[np.float64]


class SharedMeans:
    """Makes a selector of counts and mean rewards one that shares (`osel_sim.interface.selector.Shares`).

    Exchanged: of the robot's own decisions since the last exchange the number and the mean reward of each policy, and the sum of squares about these
    means: 16 bytes a policy and 8 more, whatever the number of decisions. They are sufficient for Gaussian rewards and add up exactly (but for
    rounding), so that robots that exchange after every decision believe what one that saw everything would.

    A subclass has `_counts` and `_means`, calls `_note` with every reward, `_with_fresh` and `_load_fresh` with its state, and overrides `_add` where
    it keeps more.
    """

    _counts: Counts
    _means: Means
    _fresh: tuple[Counts, Means, float] | None = None  # of its own since the last exchange; None where it does not share

    def begin(self, first: State | None) -> State:
        """Nothing is needed to begin alike."""
        self._fresh = (np.zeros_like(self._counts), np.zeros_like(self._means), 0.0)
        return {}

    def share(self) -> State:
        """`counts` int64 (P,), `means` float64 (P,), `squares` about them."""
        counts, means, squares = self._fresh or (np.zeros_like(self._counts), np.zeros_like(self._means), 0.0)
        self.begin(None)
        return {"counts": counts, "means": means, "squares": squares}

    def absorb(self, messages: Sequence[State], own: int) -> None:
        """Add what the others counted."""
        for robot, message in enumerate(messages):
            if robot != own:
                self._add(message)

    def _add(self, message: State) -> None:
        """Add one message's counts, and return nothing; see `merged_means`."""
        self._counts, self._means, _ = merged_means(self._counts, self._means, message)

    def _note(self, index: int, reward: float) -> None:
        """Count a decision of its own."""
        if self._fresh is None:
            return
        counts, means, squares = self._fresh
        if len(counts) < len(self._counts):  # a policy came in between
            counts, means = _widened(counts, len(self._counts)), _widened(means, len(self._counts))
        counts[index] += 1
        before = reward - means[index]
        means[index] += before / counts[index]
        self._fresh = counts, means, squares + before * (reward - means[index])

    def _with_fresh(self, state: State) -> State:
        """The state with what is not yet shared; as it is where nothing is."""
        if self._fresh is None:
            return state
        counts, means, squares = self._fresh
        return {**state, "fresh.counts": counts.copy(), "fresh.means": means.copy(), "fresh.squares": float(squares)}

    def _load_fresh(self, state: State) -> None:
        shared = "fresh.counts" in state
        self._fresh = (state["fresh.counts"].copy(), state["fresh.means"].copy(), state["fresh.squares"]) if shared else None


def merged_means(counts: Counts, means: Means, message: State) -> tuple[Counts, Means, float]:
    """Counts and means of both together, and by how much the sum of squares grows beyond one's own (Chan, Golub and LeVeque 1983).

    Args:
        message: as `SharedMeans.share` gives it; policies that it lacks, as its robot did not have them yet, count as never chosen.
    """
    others, theirs = (_widened(message[key], len(counts)) for key in ("counts", "means"))
    total = counts + others
    share = others / np.maximum(total, 1)
    apart = theirs - means
    return total, means + apart * share, float(message["squares"]) + float((apart**2 * counts * share).sum())


def _widened(array: NDArray[Any], length: int) -> NDArray[Any]:
    return np.append(array, np.zeros(length - len(array), array.dtype))
