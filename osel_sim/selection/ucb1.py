"""UCB1: the classic non-contextual bandit that explores by optimism."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.shared_means import SharedMeans


class UCB1Selector(SharedMeans, SelectorBase):
    """Chooses the policy of the highest mean reward so far plus width * sqrt(2 ln t / n) (Auer et al., 2002).

    n counts the policy's rewards, t all of them. Each policy is tried once first; policies with equal indices share the choice.

    Robots share by `SharedMeans`: 16 bytes a policy and 8.

    Args:
        policies, context_dim, seed: see `SelectorBase`. The context is not looked at.
        width: range of the rewards, > 0: 1 for success less small charges.

    Raises:
        UsageError: `width` is not positive.
    """

    name: ClassVar[str] = "ucb1"
    off_policy: ClassVar[bool] = True
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, *, width: float = 1.0) -> None:
        super().__init__(policies, context_dim, seed)
        if not width > 0.0:
            raise UsageError(f"width must be positive, got {width}")
        self.width = float(width)
        self._generator = np.random.default_rng(seed)
        self._counts = np.zeros(len(self.policies), np.int64)
        self._means = np.zeros(len(self.policies), np.float64)

    @property
    def settings(self) -> dict[str, Any]:
        """The width."""
        return {"width": self.width}

    def _select(self, context: Context) -> Choice:
        tried = self._counts > 0
        bonus = self.width * np.sqrt(2.0 * np.log(max(1, int(self._counts.sum()))) / np.maximum(1, self._counts))
        index = np.where(tried, self._means + bonus - self._charged, np.inf)[self.columns]
        best = index == index.max()
        propensities = best / best.sum()
        chosen = self._generator.choice(len(self.policies), p=propensities)
        return Choice(self.policies[chosen], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _expected(self, context: Context) -> NDArray[np.float64]:
        return self._means.copy()

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        index = self.known.index(choice.policy)
        self._counts[index] += 1
        self._means[index] += (reward - self._means[index]) / self._counts[index]
        self._note(index, reward)

    def _add_policy(self, name: str) -> None:
        if name in self.known:
            return
        self._counts = np.append(self._counts, 0)
        self._means = np.append(self._means, 0.0)

    def _state(self) -> State:
        state = {"counts": self._counts.copy(), "means": self._means.copy(), "random": self._generator.bit_generator.state}
        return self._with_fresh(state)

    def _load(self, state: State) -> None:
        self._counts, self._means = state["counts"].copy(), state["means"].copy()
        self._generator.bit_generator.state = state["random"]
        self._load_fresh(state)
