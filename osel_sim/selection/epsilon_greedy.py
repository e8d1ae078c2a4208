"""Epsilon-greedy, the paper's non-contextual learner."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.shared_means import SharedMeans


class EpsilonGreedySelector(SharedMeans, SelectorBase):
    """Explores with probability epsilon = min(1, policies / ((t + 1) * gap)), else takes the policy of the best mean reward so far.

    Paper, appendix "Hyperparameters", after Lattimore and Szepesvari, *Bandit Algorithms*. t counts the decisions made before this one, from 0. With
    the paper's gap of 0.01 and two policies the first 200 decisions are pure exploration, and half of them still are at the 400th. Exploring draws
    uniformly from all policies, the best one included. Policies with equal means share the greedy part; one never tried counts as best.

    Robots share by `SharedMeans`, 16 bytes a policy and 8, and t counts the rewards of all of them: what one has explored the others need not.

    Args:
        policies, context_dim, seed: see `SelectorBase`. The context is not looked at.
        gap: assumed difference in mean reward between the best policy and the next, > 0; larger stops exploring sooner.

    Raises:
        UsageError: `gap` is not positive.
    """

    name: ClassVar[str] = "epsilon_greedy"
    retires: ClassVar[bool] = True

    def __init__(self, policies: Sequence[str], context_dim: int, seed: int, *, gap: float = 0.01) -> None:
        super().__init__(policies, context_dim, seed)
        if not gap > 0.0:
            raise UsageError(f"gap must be positive, got {gap}")
        self.gap = float(gap)
        self._generator = np.random.default_rng(seed)
        self._decisions = 0
        self._counts = np.zeros(len(self.policies), np.int64)
        self._means = np.zeros(len(self.policies), np.float64)

    @property
    def settings(self) -> dict[str, Any]:
        """The gap."""
        return {"gap": self.gap}

    @property
    def epsilon(self) -> float:
        """Probability of exploring in the next decision."""
        return min(1.0, len(self.policies) / ((self._decisions + 1) * self.gap))

    def _select(self, context: Context) -> Choice:
        estimates = np.where(self._counts > 0, self._means - self._charged, np.inf)[self.columns]
        best = estimates == estimates.max()
        propensities = self.epsilon / len(self.policies) + (1.0 - self.epsilon) * best / best.sum()
        index = self._generator.choice(len(self.policies), p=propensities)
        self._decisions += 1
        return Choice(self.policies[index], dict(zip(self.policies, propensities.tolist(), strict=True)))

    def _recall(self, context: Context, choice: Choice) -> Choice:
        self._decisions += 1
        return choice

    def _expected(self, context: Context) -> NDArray[np.float64]:
        return self._means.copy()

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        index = self.known.index(choice.policy)
        self._counts[index] += 1
        self._means[index] += (reward - self._means[index]) / self._counts[index]
        self._note(index, reward)

    def _add(self, message: State) -> None:
        super()._add(message)
        self._decisions += int(message["counts"].sum())

    def _add_policy(self, name: str) -> None:
        if name in self.known:
            return
        self._counts = np.append(self._counts, 0)
        self._means = np.append(self._means, 0.0)

    def _state(self) -> State:
        state = {
            "decisions": self._decisions,
            "counts": self._counts.copy(),
            "means": self._means.copy(),
            "random": self._generator.bit_generator.state,
        }
        return self._with_fresh(state)

    def _load(self, state: State) -> None:
        self._decisions = state["decisions"]
        self._counts, self._means = state["counts"].copy(), state["means"].copy()
        self._generator.bit_generator.state = state["random"]
        self._load_fresh(state)
