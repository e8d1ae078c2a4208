"""LinUCB that forgets at an even pace: what is long ago weighs little."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.bayesian import DEVIATION
from osel_sim.selection.scaling import RunningComponents

Array = NDArray[np.float64]

EQUAL = 1e-9
"""Bounds no further apart, in standard deviations of the rewards, share a choice."""


class DiscountedLinUCBSelector(SelectorBase):
    """Chooses the policy whose reward is highest at `optimism` deviations above its mean, by a linear model in which each decision counts `discount`
    times as much as the one after it.

    D-LinUCB (Russac, Vernade and Cappe, *Weighted Linear Bandits for Non-Stationary Environments*, NeurIPS 2019), with a model of each policy's own:
    weights are ridge regressions V^-1 b of discounted sums, and the deviation of a prediction is sqrt(x' V^-1 W V^-1 x), where W has the discount
    squared. The prior (`ridge` times the identity) is not forgotten, so that a policy that is not chosen becomes uncertain again and is tried.

    Rewards are measured from the mean of all policies and in units of their standard deviation, both discounted: their scale and offset change
    nothing, and a policy that joins, or that is forgotten, is believed to be as good as the others are.

    Args:
        policies, context_dim, seed: see `SelectorBase`. Only policies with equal bounds share a choice by chance.
        components: principal components of the contexts seen (`RunningComponents`), beside a constant.
        discount: in (0, 1]; about 1 / (1 - discount) decisions count.
        optimism: >= 0, in standard deviations of the rewards.
        ridge: > 0.

    Raises:
        UsageError: a number out of range.
    """

    name: ClassVar[str] = "linucb_discounted"
    off_policy: ClassVar[bool] = True
    retires: ClassVar[bool] = True

    def __init__(
        self,
        policies: Sequence[str],
        context_dim: int,
        seed: int,
        *,
        components: int = 12,
        discount: float = 0.998,
        optimism: float = 1.0,
        ridge: float = 2.0,
    ) -> None:
        super().__init__(policies, context_dim, seed)
        if (
            components < 1
            or not 0.0 < discount <= 1.0
            or not (math.isfinite(optimism) and optimism >= 0.0)
            or not (math.isfinite(ridge) and ridge > 0.0)
        ):
            raise UsageError(
                "components must be at least 1, discount in (0, 1], optimism >= 0 and ridge > 0, "
                f"got {components}, {discount}, {optimism} and {ridge}"
            )
        self._settings = {"components": components, "discount": discount, "optimism": optimism, "ridge": ridge}
        self._generator = np.random.default_rng(seed)
        self._space = RunningComponents(context_dim, components)
        shape = (len(self.policies), components + 1)
        self._products, self._squares, self._vectors = np.zeros((*shape, shape[1])), np.zeros((*shape, shape[1])), np.zeros(shape)
        self._spread = 0.0  # discounted sum of squares of rewards about their mean

    @property
    def settings(self) -> dict[str, Any]:
        """Those of the constructor."""
        return self._settings

    def _select(self, context: Context) -> Choice:
        row, inverses = self._row(context), self._inverses()
        ridge = self._settings["ridge"] * np.eye(len(row))
        pulls = inverses @ row
        spread = np.sqrt(np.maximum(np.einsum("pi,pij,pj->p", pulls, self._squares + ridge, pulls), 0.0))
        unit = self._deviation()
        scores = (self._means(pulls) - self._charged) / unit + self._settings["optimism"] * spread
        scores = scores[self.columns]
        best = scores >= scores.max() - EQUAL
        shares = best / best.sum()
        index = int(self._generator.choice(len(self.policies), p=shares))
        return Choice(self.policies[index], dict(zip(self.policies, shares.tolist(), strict=True)))

    def _expected(self, context: Context) -> Array:
        return self._centre() + self._means(self._inverses() @ self._row(context))

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        discount, index = self._settings["discount"], self.known.index(choice.policy)
        self._space.add(context)
        row, (before, mean) = self._row(context), self._all()
        self._spread = discount * (self._spread + before / (discount * before + 1.0) * (reward - mean) ** 2)
        self._products *= discount
        self._squares *= discount**2
        self._vectors *= discount
        self._products[index] += np.outer(row, row)
        self._squares[index] += np.outer(row, row)
        self._vectors[index] += reward * row

    def _all(self) -> tuple[float, float]:
        """How many decisions count, and their mean reward."""
        count = float(self._products[:, 0, 0].sum())
        return count, float(self._vectors[:, 0].sum() / count) if count > 0.0 else 0.0

    def _centre(self) -> float:
        """Mean reward of the policies that were chosen, each with one decision's weight of the mean over decisions: how good the most chosen one is
        says little of the others."""
        count, mean = self._all()
        counts = self._products[:, 0, 0]
        return float(((self._vectors[:, 0] + mean) / (counts + 1.0))[counts > 0.0].mean()) if count > 0.0 else 0.0

    def _deviation(self) -> float:
        """Standard deviation of rewards; a guess until two of them differ."""
        count, mean = self._all()
        deviation = math.sqrt(self._spread / count) if count > 0.0 else 0.0
        return deviation if deviation > 1e-9 * abs(mean) else DEVIATION

    def _means(self, pulls: Array) -> Array:
        """Expected rewards (P,) less the centre, given each policy's V^-1 x."""
        return np.asarray(np.einsum("pi,pi->p", pulls, self._vectors - self._centre() * self._products[:, :, 0]), np.float64)

    def _row(self, context: Context) -> Array:
        return np.concatenate([[1.0], self._space.transform(context).astype(np.float64)])

    def _inverses(self) -> Array:
        return np.asarray(np.linalg.inv(self._products + self._settings["ridge"] * np.eye(self._products.shape[1])), np.float64)

    def _add_policy(self, name: str) -> None:
        if name in self.known:
            return
        width = self._products.shape[1]
        self._products, self._squares = (np.concatenate([own, np.zeros((1, width, width))]) for own in (self._products, self._squares))
        self._vectors = np.concatenate([self._vectors, np.zeros((1, width))])

    def _state(self) -> State:
        own = {"products": self._products.copy(), "squares": self._squares.copy(), "vectors": self._vectors.copy(), "spread": self._spread}
        return {**own, **self._space.state(), "random": self._generator.bit_generator.state}

    def _load(self, state: State) -> None:
        self._products, self._squares, self._vectors = (state[key].copy() for key in ("products", "squares", "vectors"))
        self._spread = state["spread"]
        self._space.load(state)
        self._generator.bit_generator.state = state["random"]
