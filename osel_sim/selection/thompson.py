"""Gaussian Thompson sampling: the best of the learners that look at no context."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.shared_means import SharedMeans, merged_means
from osel_sim.statistics.best import probability_of_best


class ThompsonSelector(SharedMeans, SelectorBase):
    """Chooses each policy with the probability that its mean reward is the highest, by what has been seen.

    The belief about a policy with n rewards is Gaussian: their mean, drawn towards the mean of all rewards by one observation's weight, with
    variance noise / (n + 1). The noise is the rewards' variance about their policy's mean, pooled over the policies, with one observation of
    variance 1 to start from. Usually one draws from the beliefs and takes the highest; here the probabilities are integrated numerically and the
    choice is drawn from them, which is the same, and makes the propensities exact.

    Robots share by `SharedMeans`: 16 bytes a policy and 8.

    Args:
        policies, context_dim, seed: see `SelectorBase`. The context is not looked at.
    """

    name: ClassVar[str] = "thompson"
    off_policy: ClassVar[bool] = True
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int) -> None:
        super().__init__(policies, context_dim, seed)
        self._generator = np.random.default_rng(seed)
        self._counts = np.zeros(len(self.policies), np.int64)
        self._means = np.zeros(len(self.policies), np.float64)
        self._squares = 0.0

    def _select(self, context: Context) -> Choice:
        noise = (1.0 + self._squares) / (1.0 + int(self._counts.sum()))
        means, deviations = self._expected(context) - self._charged, np.sqrt(noise / (self._counts + 1.0))
        propensities = probability_of_best(means[self.columns], deviations[self.columns])
        index = self._generator.choice(len(self.policies), p=propensities)
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _expected(self, context: Context) -> NDArray[np.float64]:
        total = int(self._counts.sum())
        overall = float((self._counts * self._means).sum() / total) if total else 0.0
        return np.asarray((self._counts * self._means + overall) / (self._counts + 1.0), np.float64)

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        index = self.known.index(choice.policy)
        self._counts[index] += 1
        before = reward - self._means[index]
        self._means[index] += before / self._counts[index]
        self._squares += before * (reward - self._means[index])
        self._note(index, reward)

    def _add(self, message: State) -> None:
        self._counts, self._means, more = merged_means(self._counts, self._means, message)
        self._squares += more

    def _add_policy(self, name: str) -> None:
        if name in self.known:
            return
        self._counts = np.append(self._counts, 0)
        self._means = np.append(self._means, 0.0)

    def _state(self) -> State:
        values = {"counts": self._counts.copy(), "means": self._means.copy(), "squares": self._squares}
        return self._with_fresh({**values, "random": self._generator.bit_generator.state})

    def _load(self, state: State) -> None:
        self._counts, self._means, self._squares = state["counts"].copy(), state["means"].copy(), state["squares"]
        self._generator.bit_generator.state = state["random"]
        self._load_fresh(state)
