"""Keeping to a budget: a selector that spends cents where they help most, and never more than there are."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import BudgetError, DataError, UnknownNameError, UsageError
from osel_sim.interface.selector import Choice, Context, Selector, State

Array = NDArray[np.float64]

RECENT = 256
"""Decisions of which the price of a cent is computed."""

ROUNDING = 1e-9
"""Cents by which sums of prices may differ in the last bits."""

OVERRULED = "overruled"
"""Key in the details of a choice that the budget made, and not the selector within."""


@dataclass(frozen=True)
class Budget:
    """How much may be spent.

    Attributes:
        cents: that all decisions of a period may cost together, >= 0.
        decisions: of a period, >= 1. A new one begins after each, and what the last one left over is gone.
        most: policy -> the most that one decision may cost where it is chosen, in cents, >= 0.

    Raises:
        UsageError: a number out of range.
        BudgetError: it pays for no policy at all.
    """

    cents: float
    decisions: int
    most: Mapping[str, float]

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cents) and self.cents >= 0.0) or self.decisions < 1:
            raise UsageError(f"a budget must be finite, >= 0 cents, for at least 1 decision, got {self.cents} for {self.decisions}")
        if not self.most or not all(math.isfinite(price) and price >= 0.0 for price in self.most.values()):
            raise UsageError(f"prices of policies must be finite and >= 0, got {dict(self.most)}")
        if self.cents < min(self.most.values()) - ROUNDING:
            policy, price = min(self.most.items(), key=lambda item: item[1])
            raise BudgetError(f"{self.cents:g} cents pay for no decision: the cheapest policy, {policy}, may cost {price:g}, and none is free")

    def of(self, policy: str) -> float:
        """The most that one decision may cost.

        Raises:
            UnknownNameError: no such policy.
        """
        if policy not in self.most:
            raise UnknownNameError("policy", policy, self.most, "those that the budget has prices of")
        return self.most[policy]


class Budgeted:
    """Any selector, made to keep to a budget.

    Each cent has a price in reward, the dual price of the budget: a policy is chosen as if its reward were less by that times what it is expected to
    cost. The price is that at which the last `RECENT` decisions, each going to the policy of the highest expected reward less charge, would have cost
    what the budget has left for each decision to come (bandits with knapsacks, Badanidiyuru et al. 2013; solved again at every decision as in
    Jasin and Kumar 2012, so that what was overspent is saved later). It is 0 while the budget does not bind. A selector that tells what it expects
    (`SelectorBase.expected`) is charged when it chooses, and learns rewards as they are. Any other learns from rewards less what the episode's cents
    were worth, and `auto` learns beside it what to expect.

    A policy that may cost more than is left is not chosen, whatever it would most likely cost: its probability goes to the others in proportion.

    Args:
        selector: the selector within, whose policies the budget has prices of.
        budget: to keep to.
        context_dim, seed: of the selector within.

    Attributes:
        spent: cents in the period so far.
        total: cents since the beginning.
        duals: price of a cent, in reward, at each decision.
    """

    def __init__(self, selector: Selector, budget: Budget, context_dim: int, seed: int) -> None:
        self.inner, self.budget = selector, budget
        for name in selector.policies:
            budget.of(name)
        self.spent = self.total = 0.0
        self.duals: list[float] = []
        self._decided = 0
        self._expected: deque[Array] = deque(maxlen=RECENT)
        self._prices = {name: [0.5 * budget.of(name), 1.0] for name in selector.policies}  # sums of prices, from a guess, and how many
        self._paid = 0.0
        self._generator = np.random.default_rng([seed, RECENT])
        self._guide = None if self._told(np.zeros(context_dim, np.float32)) is not None else self._make_guide(context_dim, seed)

    @property
    def policies(self) -> tuple[str, ...]:
        """Those of the selector within."""
        return self.inner.policies

    @property
    def left(self) -> float:
        """Cents for the rest of the period."""
        return self.budget.cents - self.spent

    @property
    def affordable(self) -> tuple[str, ...]:
        """The policies that the next decision may go to."""
        return tuple(name for name in self.policies if self.budget.of(name) <= self.left + ROUNDING)

    @property
    def broke(self) -> BudgetError:
        """What is wrong where there is none."""
        cheapest = min(self.policies, key=self.budget.of)
        return BudgetError(
            f"the budget is spent: {self.left:.4g} cents are left of {self.budget.cents:g}, the cheapest policy, {cheapest}, may cost "
            f"{self.budget.of(cheapest):.4g}, and none is free"
        )

    @property
    def dual(self) -> float:
        """Price of a cent, in reward, over the last quarter of the decisions: about what one more cent would have brought."""
        late = self.duals[len(self.duals) * 3 // 4 :]
        return float(np.mean(late)) if late else 0.0

    def select(self, context: Context) -> Choice:
        """Choose a policy that can be paid.

        Raises:
            BudgetError: there is none.
        """
        affordable = self.affordable
        if not affordable:
            raise self.broke
        expected = self._told(context) if self._guide is None else self._guide.expected(context)
        self._expected.append(np.asarray(expected, np.float64))
        prices = np.array([total / count for total, count in (self._prices[name] for name in self.policies)])
        pace = self.left / (self.budget.decisions - self._decided % self.budget.decisions)
        self.duals.append(dual_price(np.array(self._expected), prices, pace))
        if self._guide is None:
            self.inner.charges = dict(zip(self.policies, (self.duals[-1] * prices).tolist(), strict=True))  # type: ignore[attr-defined]
        return self._within(self.inner.select(context), affordable)

    def pay(self, policy: str, price: float) -> None:
        """What a decision cost, in cents."""
        self.spent += price
        self.total += price
        self._paid = price
        self._prices[policy][0] += price
        self._prices[policy][1] += 1.0
        self._decided += 1
        if self._decided % self.budget.decisions == 0:
            self.spent = 0.0

    def update(self, context: Context, choice: Choice, reward: float) -> None:
        """Learn from the reward of an earlier choice; of one that was overruled only where the selector within may learn from others' choices."""
        charge = 0.0
        if self._guide is not None:
            self._guide.update(context, choice, reward)
            charge = (self.duals[-1] if self.duals else 0.0) * self._paid
        self._paid = 0.0
        if OVERRULED not in choice.details or getattr(self.inner, "off_policy", False):
            self.inner.update(context, choice, reward - charge)

    def add_policy(self, name: str) -> None:
        """Make one more policy available, of which the budget has the price."""
        self._prices.setdefault(name, [0.5 * self.budget.of(name), 1.0])
        self._change("add_policy", name)

    def retire_policy(self, name: str) -> None:
        """Take a policy out."""
        self._change("retire_policy", name)

    def state_dict(self) -> State:
        """The state of the selector within, and under `budget.` the rest."""
        own: State = {
            "sums": [self.spent, self.total, self._paid],
            "decided": self._decided,
            "duals": np.array(self.duals),
            "expected": np.array(self._expected).reshape(-1, len(self.policies)),
            "prices": {name: list(pair) for name, pair in self._prices.items()},
            "random": self._generator.bit_generator.state,
            **({} if self._guide is None else {f"guide.{key}": value for key, value in self._guide.state_dict().items()}),
        }
        return {**self.inner.state_dict(), **{f"budget.{key}": value for key, value in own.items()}}

    def load_state_dict(self, state: State) -> None:
        """Take over a state.

        Raises:
            DataError: it is of a selector without a budget, or of another kind.
        """
        own = {key.removeprefix("budget."): value for key, value in state.items() if key.startswith("budget.")}
        try:
            self.spent, self.total, self._paid = own["sums"]
            self._decided, self.duals = own["decided"], own["duals"].tolist()
            self._expected = deque(own["expected"].copy(), RECENT)
            self._prices = {name: list(pair) for name, pair in own["prices"].items()}
            self._generator.bit_generator.state = own["random"]
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise DataError(f"selector state: is of no selector with a budget ({type(error).__name__}: {error})") from None
        if self._guide is not None:
            self._guide.load_state_dict({key.removeprefix("guide."): value for key, value in own.items() if key.startswith("guide.")})
        self.inner.load_state_dict({key: value for key, value in state.items() if not key.startswith("budget.")})

    def _change(self, method: str, name: str) -> None:
        """Let a policy join or leave: what was expected in recent decisions was of others."""
        self._expected.clear()
        for selector in (self.inner, self._guide):
            if selector is not None:
                getattr(selector, method)(name)

    def _told(self, context: Context) -> Array | None:
        """What the selector within expects of each policy, if it tells."""
        tell = getattr(self.inner, "expected", None)
        return None if tell is None else tell(context)

    def _make_guide(self, context_dim: int, seed: int) -> Any:
        from osel_sim.selection.kernel_ucb import KernelUCBSelector

        return KernelUCBSelector(self.policies, context_dim, seed)

    def _within(self, choice: Choice, affordable: Sequence[str]) -> Choice:
        """The choice with probabilities of what can be paid alone."""
        if len(affordable) == len(self.policies):
            return choice
        kept = {name: choice.propensities[name] if name in affordable else 0.0 for name in self.policies}
        total = math.fsum(kept.values())
        if total <= 0.0:
            kept, total = {name: float(name in affordable) for name in self.policies}, float(len(affordable))
        propensities = {name: value / total for name, value in kept.items()}
        if choice.policy in affordable:
            return Choice(choice.policy, propensities, choice.details)
        names = list(affordable)
        weights = np.array([propensities[name] for name in names])
        drawn = names[int(self._generator.choice(len(names), p=weights / weights.sum()))]
        return Choice(drawn, propensities, {OVERRULED: 1.0})


def dual_price(expected: Array, prices: Array, pace: float) -> float:
    """Lowest price of a cent, in reward, at which decisions cost no more than `pace` on average.

    Args:
        expected: (n, P) expected reward of each policy in some decisions, n >= 1.
        prices: (P,) cents that each policy is expected to cost.
        pace: cents a decision.

    Returns:
        0 where the budget does not bind. Where it cannot be kept to by choosing the cheapest policy always, the price from which on that is chosen.
    """
    cheapest = int(prices.argmin())
    dearer = prices > prices[cheapest]
    by_policy, cents = np.ascontiguousarray(expected.T), prices[:, None]  # numpy goes through a few long rows more than twice as fast

    def cost(dual: float) -> float:
        scores = by_policy - dual * cents
        best = scores >= scores.max(axis=0) - 1e-12
        return float(np.where(best, cents, np.inf).min(axis=0).mean())

    if not dearer.any() or cost(0.0) <= pace:
        return 0.0
    gains = (expected[:, dearer] - expected[:, [cheapest]]) / (prices[dearer] - prices[cheapest])
    low, high = 0.0, max(0.0, float(gains.max()))
    for _ in range(14):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if cost(middle) > pace else (low, middle)
    return high
