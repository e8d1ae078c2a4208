"""The budgets that a replay's settings ask for."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from osel_sim.api.replay_changes import changes_asked
from osel_sim.core.errors import BudgetError, SettingError

if TYPE_CHECKING:
    from osel_sim.analysis.budgets import BudgetPlan
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.api.replay_settings import ReplayConfig

WITHIN = ("auto",)
"""Selectors that are replayed within budgets unless others are named: each takes as long again for every budget."""


def check_budget(config: "ReplayConfig", known: bool) -> None:
    """Refuse a budget that could not be replayed, instead of leaving it out.

    Args:
        known: whether the outcomes of every policy are.

    Raises:
        SettingError: the stream is to change, or only the outcomes of what was chosen are known.
    """
    if config.budget_cents is None:
        if config.budget_per is not None:
            raise SettingError("budget_per", "is the number of decisions that --budget-cents is for: give that, too")
        return
    if changes_asked(config):
        raise SettingError("budget_cents", "is for streams that do not change: leave --join, --leave and --drift out")
    if not known:
        raise SettingError("budget_cents", f"needs the outcomes of every policy: {config.log} has those of what was chosen only")


def plan_budgets_of(config: "ReplayConfig", log: "LoggedOutcomes", setup: "Setup", selectors: Sequence[str]) -> "BudgetPlan | None":
    """What to replay within budgets; None where no budget was given.

    Raises:
        SettingError: the budget pays for no decision.
        DataError: the log lacks prices.
    """
    if config.budget_cents is None:
        return None
    from osel_sim.analysis.budgets import plan_budgets

    names = selectors if config.selectors else [name for name in selectors if name in WITHIN]
    budget = config.budget_cents, config.budget_per or config.decisions or len(log)
    try:
        return plan_budgets(log, setup, names, budget, config.seeds, config.decisions)
    except BudgetError as error:
        raise SettingError("budget_cents", str(error)) from None
