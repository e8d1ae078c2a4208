"""LinUCB that forgets at an even pace: what is long ago weighs little."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.interface.selector import Choice, Context, State
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.scaling import RunningComponents

Array = NDArray[np.float64]


class DiscountedLinUCBSelector(SelectorBase):
    """Chooses the policy whose reward is highest at `optimism` deviations above its mean, by a linear model in which each decision counts `discount`
    times as much as the one after it.

    D-LinUCB (Russac, Vernade and Cappe, *Weighted Linear Bandits for Non-Stationary Environments*, NeurIPS 2019), with a model of each policy's own:
    weights are ridge regressions V^-1 b of discounted sums, and the deviation of a prediction is sqrt(x' V^-1 W V^-1 x), where W has the discount
    squared. The prior (`ridge` times the identity) is not forgotten, so that a policy that is not chosen becomes uncertain again and is tried.

    Args:
        policies, context_dim, seed: see `SelectorBase`. Only policies with equal bounds share a choice by chance.
        components: principal components of the contexts seen (`RunningComponents`), beside a constant.
        discount: in (0, 1]; about 1 / (1 - discount) decisions count.
        optimism: >= 0.
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
        optimism: float = 0.5,
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

    @property
    def settings(self) -> dict[str, Any]:
        """Those of the constructor."""
        return self._settings

    def _select(self, context: Context) -> Choice:
        row, inverses = self._row(context), self._inverses()
        ridge = self._settings["ridge"] * np.eye(len(row))
        pulls = inverses @ row
        spread = np.sqrt(np.maximum(np.einsum("pi,pij,pj->p", pulls, self._squares + ridge, pulls), 0.0))
        scores = np.einsum("pi,pi->p", pulls, self._vectors) + self._settings["optimism"] * spread - self._charged
        scores = scores[self.columns]
        best = scores >= scores.max() - 1e-12
        shares = best / best.sum()
        index = int(self._generator.choice(len(self.policies), p=shares))
        return Choice(self.policies[index], dict(zip(self.policies, shares.tolist(), strict=True)))

    def _expected(self, context: Context) -> Array:
        return np.asarray(np.einsum("pi,pi->p", self._inverses() @ self._row(context), self._vectors), np.float64)

    def _update(self, context: Context, choice: Choice, reward: float) -> None:
        discount, index = self._settings["discount"], self.known.index(choice.policy)
        self._space.add(context)
        row = self._row(context)
        self._products *= discount
        self._squares *= discount**2
        self._vectors *= discount
        self._products[index] += np.outer(row, row)
        self._squares[index] += np.outer(row, row)
        self._vectors[index] += reward * row

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
        own = {"products": self._products.copy(), "squares": self._squares.copy(), "vectors": self._vectors.copy()}
        return {**own, **self._space.state(), "random": self._generator.bit_generator.state}

    def _load(self, state: State) -> None:
        self._products, self._squares, self._vectors = (state[key].copy() for key in ("products", "squares", "vectors"))
        self._space.load(state)
        self._generator.bit_generator.state = state["random"]
