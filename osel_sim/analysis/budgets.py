"""What selectors come to within budgets on a log, against the best that could have been done with as much money."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.engine import Part, Setup
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.core.errors import BudgetError, DataError
from osel_sim.formats.replay_result import Choices
from osel_sim.selection.budget import Budget
from osel_sim.selection.reward import RewardWeights

MULTIPLES = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Of the budget that was asked for: where the curve is replayed."""

SEEDS = 8
"""Most orders that each point is replayed in."""


@dataclass(frozen=True)
class BudgetPlan:
    """What to replay for a curve of budgets, and what to make of it.

    Attributes:
        part: each budget is a setup of it.
        budgets: in the order of the setups.
        asked: cents that were asked for.
        weights: of the reward.
    """

    part: Part
    budgets: tuple[Budget, ...]
    asked: float
    weights: RewardWeights

    def measured(self, choices: Sequence[Choices]) -> dict[str, Any]:
        """What `replay.json` has under `budget`; see docs/budgets.md."""
        log, weights = self.part.log, self.weights
        rewards, prices = log.mean_rewards(weights), mean_over_repeats(log.price)
        decisions = choices[0].order.shape[1]
        whole = [own.cents / own.decisions for own in self.budgets]  # cents a decision
        free = min(self.budgets[0].most.values()) <= 0.0
        bounds = {
            "hindsight": [best_within(rewards, prices, pace, free) for pace in whole],
            "mix": [best_within(rewards.mean(axis=0)[None], prices.mean(axis=0)[None], pace, free) for pace in whole],
        }
        expected = [_expected(log.rewards(weights), log.price, pace, free, best) for pace, (best, _) in zip(whole, bounds["hindsight"], strict=True)]
        return {
            "asked": self.asked,
            "period": self.budgets[0].decisions,
            "decisions": decisions,
            "seeds": len(choices[0].order),
            "most": dict(self.budgets[0].most),
            "cents": [own.cents for own in self.budgets],
            "selectors": {name: [_received(log, weights, own, name) for own in choices] for name in self.part.selectors},
            "oracles": {name: [value for value, _ in found] for name, found in bounds.items()} | {"expected": expected},
            "dual_prices": [dual for _, dual in bounds["hindsight"]],
        }


def plan_budgets(
    log: LoggedOutcomes, setup: Setup, selectors: Sequence[str], budget: tuple[float, int], seeds: int, decisions: int | None = None
) -> BudgetPlan:
    """Plan a curve around a budget.

    Args:
        log: complete instances.
        setup: under which it is replayed without a budget.
        selectors: to replay.
        budget: cents, and for how many decisions.
        seeds: wanted.
        decisions: length of a stream; None: all instances.

    Raises:
        DataError: the log lacks prices.
        BudgetError: the budget pays for no decision.
    """
    ran = np.isfinite(log.rewards(setup.weights))
    if not np.isfinite(log.price[ran]).all():
        raise DataError(f"{log.source}: lacks prices of some episodes, which a budget needs")
    cents, period = budget
    prices = np.where(ran, log.price, -np.inf).max(axis=(0, 2))
    most = dict(zip(log.policies, prices.tolist(), strict=True))
    asked = Budget(cents, period, most)
    found = []
    for multiple in MULTIPLES:
        try:
            found.append(asked if multiple == 1.0 else Budget(multiple * cents, period, most))
        except BudgetError:  # too little for any decision: the curve begins above it
            continue
    setups = [replace(setup, budget=own) for own in found]
    return BudgetPlan(Part(log, setups, list(selectors), range(min(seeds, SEEDS)), decisions), tuple(found), cents, setup.weights)


def best_within(rewards: Array, prices: Array, pace: float, free: bool) -> tuple[float, float]:
    """The most reward a decision that costs no more than `pace` on average, and the price of a cent there, in reward.

    The linear program of a knapsack with a choice in each row, by its dual: the least over prices of a cent, >= 0, of what the best policies earn
    less what they cost at that price, plus what the budget is worth at it. One row's choice may be mixed, so it is a bound, to one row's reward.

    Args:
        rewards, prices: (N, P) of each policy on each instance.
        pace: cents a decision.
        free: some policy costs nothing; else a decision may be left out, for no reward and no price.
    """
    if not free:
        nothing = np.zeros((len(rewards), 1))
        rewards, prices = np.concatenate([rewards, nothing], axis=1), np.concatenate([prices, nothing], axis=1)

    def cost(dual: float) -> float:
        chosen = (rewards - dual * prices - 1e-12 * prices).argmax(axis=1)
        return float(prices[np.arange(len(prices)), chosen].mean())

    low, high = 0.0, 0.0
    if cost(0.0) > pace:
        high = 1.0
        while cost(high) > pace and high < 1e9:
            high *= 2.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if cost(middle) > pace else (low, middle)
    return float((rewards - high * prices).max(axis=1).mean()) + high * pace, high


def _expected(rewards: Array, prices: Array, pace: float, free: bool, hindsight: float) -> float | None:
    """What the hindsight oracle loses where it chooses on one half of an instance's repeats and is scored on the other, both ways, taken off what it
    has on all instances; from those with repeats, which have to be a fair sample. None where there are none.

    Args:
        rewards, prices: (N, P, R).
        hindsight: reward of the hindsight oracle, by `best_within` on all instances.
    """
    known = np.isfinite(rewards)
    number = np.cumsum(known, axis=2) - 1
    halves = [tuple(mean_over_repeats(np.where(known & (number % 2 == parity), table, np.nan)) for table in (rewards, prices)) for parity in (0, 1)]
    rows = np.logical_and.reduce([np.isfinite(table).all(axis=1) for half in halves for table in half])
    if not free or not rows.any():
        return None
    values = []
    for (own, costs), (others, _) in (halves, halves[::-1]):
        _, dual = best_within(own[rows], costs[rows], pace, free)
        chosen = (own[rows] - dual * costs[rows] - 1e-12 * costs[rows]).argmax(axis=1)
        values.append(float(others[rows][np.arange(len(chosen)), chosen].mean()))
    here, _ = best_within(mean_over_repeats(rewards[rows]), mean_over_repeats(prices[rows]), pace, free)
    return hindsight - here + float(np.mean(values))


def _received(log: LoggedOutcomes, weights: RewardWeights, choices: Choices, name: str) -> dict[str, float]:
    """Means over the orders; a decision for which no policy could be paid earns nothing and costs nothing."""
    chosen = choices.chosen[name].astype(np.int64)
    made = chosen >= 0

    def of(table: NDArray[np.float64]) -> Array:
        values = np.take_along_axis(choices.outcomes(table), np.maximum(chosen, 0)[:, :, None], axis=2)[:, :, 0]
        return np.where(made, values, 0.0)

    rewards, spent = of(log.rewards(weights)), of(log.price).sum(axis=1)
    means = rewards.mean(axis=1)
    return {
        "reward": float(means.mean()),
        "error": float(means.std(ddof=1) / np.sqrt(len(means))) if len(means) > 1 else 0.0,
        "success": float(of(log.success).mean()),
        "spent": float(spent.mean()),
        "most_spent": float(spent.max()),
        "made": float(made.mean()),
    }
