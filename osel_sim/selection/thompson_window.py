"""Thompson sampling on a sliding window: it forgets what is long ago, whatever happened since."""

from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.statistics.best import probability_of_best


class WindowThompsonSelector(SelectorBase):
    """`thompson` that believes what the last `window` rewards say, as if there had been no others.

    Sliding-window Thompson sampling (Trovo, Paladino, Restelli and Gatti, *Sliding-Window Thompson Sampling for Non-Stationary Settings*, JAIR 2020),
    with Gaussian beliefs as `ThompsonSelector` has them. A policy that was not chosen in the window is believed to be as good as all are on average,
    with the variance of one reward, and is tried again: that is how one that became better is noticed, and what it costs where nothing changes.

    Args:
        policies, context_dim, seed: see `SelectorBase`. The context is not looked at.
        window: number of rewards, >= 1.

    Raises:
        UsageError: `window` is not positive.
    """

    name: ClassVar[str] = "thompson_window"
    off_policy: ClassVar[bool] = True
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, *, window: int = 400) -> None:
        super().__init__(policies, context_dim, seed)
        if window < 1:
            raise UsageError(f"window must be at least 1, got {window}")
        self.window = window
        self._generator = np.random.default_rng(seed)
        self._seen: deque[tuple[int, float]] = deque(maxlen=window)

    @property
    def settings(self) -> dict[str, Any]:
        """The window."""
        return {"window": self.window}

    def _select(self, context: Context) -> Choice:
        chosen, rewards = self._arrays()
        counts = np.bincount(chosen, minlength=len(self.known))
        means = np.bincount(chosen, rewards, len(self.known)) / np.maximum(counts, 1)
        noise = (1.0 + float(((rewards - means[chosen]) ** 2).sum())) / (1.0 + len(rewards))
        believed, deviations = self._expected(context) - self._charged, np.sqrt(noise / (counts + 1.0))
        propensities = probability_of_best(believed[self.columns], deviations[self.columns])
        index = self._generator.choice(len(self.policies), p=propensities)
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _expected(self, context: Context) -> NDArray[np.float64]:
        chosen, rewards = self._arrays()
        counts, sums = np.bincount(chosen, minlength=len(self.known)), np.bincount(chosen, rewards, len(self.known))
        return np.asarray((sums + (rewards.mean() if len(rewards) else 0.0)) / (counts + 1.0), np.float64)

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        self._seen.append((self.known.index(choice.policy), reward))

    def _arrays(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Columns and rewards in the window."""
        return np.array([index for index, _ in self._seen], np.int64), np.array([reward for _, reward in self._seen], np.float64)

    def _state(self) -> State:
        chosen, rewards = self._arrays()
        return {"chosen": chosen, "rewards": rewards, "random": self._generator.bit_generator.state}

    def _load(self, state: State) -> None:
        self._seen = deque(zip(state["chosen"].tolist(), state["rewards"].tolist(), strict=True), self.window)
        self._generator.bit_generator.state = state["random"]
