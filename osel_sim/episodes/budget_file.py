"""What a live run spent of its budget, written when it ends."""

from collections.abc import Sequence
from typing import Literal, override

import numpy as np

from osel_sim.episodes.run_subscribers import Run, RunSubscriber
from osel_sim.formats.budget import Spent, write_budget
from osel_sim.formats.journal import Decision
from osel_sim.interface.outcome import credited
from osel_sim.selection.budget import Budgeted

Graded = Literal["success", "subgoals"]
DOLLAR = 100.0
"""Cents."""


class BudgetFile(RunSubscriber):
    """Writes `budget.json` into the run's folder.

    Args:
        selector: that keeps to the budget.
        success: what counts as success in the reward: `success` or `subgoals`.
        wanted: decisions that the run is to have.

    Attributes:
        spent: what the file has; None before the run has ended.
    """

    def __init__(self, selector: Budgeted, success: Graded, wanted: int) -> None:
        self._selector, self._success, self._wanted = selector, success, wanted
        self.spent: Spent | None = None

    @override
    def on_end(self, run: Run) -> None:
        selector, decisions = self._selector, list(run.decisions)
        ended = "" if selector.affordable or len(decisions) >= self._wanted else str(selector.broke)
        reward = DOLLAR * selector.dual
        success = reward + DOLLAR * charged_per_cent(decisions, self._success) if reward else 0.0
        budget = selector.budget
        self.spent = Spent(
            budget.cents, budget.decisions, len(decisions), selector.total, ended, reward, max(0.0, success), tuple(selector.duals[: len(decisions)])
        )
        write_budget(run.folder, self.spent)


def charged_per_cent(decisions: Sequence[Decision], success: Graded) -> float:
    """What an episode that costs a cent more is charged more for time and price, in reward: the slope of least squares over decisions.

    A cent that buys reward buys so much more success: what the reward charges for it comes on top.

    Args:
        success: what counts as success in the reward.
    """
    valid = [decision for decision in decisions if decision.reward is not None]
    prices = np.array([decision.price for decision in valid])
    charges = np.array([credited(decision, success) - (decision.reward or 0.0) for decision in valid])
    spread = float(((prices - prices.mean()) ** 2).sum()) if len(valid) > 1 else 0.0
    return float(((prices - prices.mean()) * charges).sum()) / spread if spread > 0.0 else 0.0
