"""The budget of a live run: a selector that keeps to it, and what the run says of it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import BudgetError, SettingError

if TYPE_CHECKING:
    from osel_sim.api.run_settings import RunConfig
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.suite import Task
    from osel_sim.selection.budget import Budget


def budget_of(config: "RunConfig", tasks: "Sequence[Task]", policies: "Sequence[PolicySpec]") -> "Budget | None":
    """The budget that the settings ask for; None where they ask for none.

    Args:
        policies: those that ever join included.

    Raises:
        SettingError: it pays for no policy, or there is a period and no budget.
    """
    from osel_sim.episodes.drivers import with_fallbacks
    from osel_sim.episodes.most_costs import most_costs
    from osel_sim.selection.budget import Budget

    if config.budget_cents is None:
        if config.budget_per is not None:
            raise SettingError("budget_per", "is the number of decisions that --budget-cents is for: give that, too")
        return None
    if config.monitor is not None:
        raise SettingError("budget_cents", "cannot be kept where a monitor hands over within the episode: leave --monitor out")
    horizon = max(task.info.horizon for task in tasks)
    try:
        most = most_costs(policies, with_fallbacks(policies, config.policies_dir), horizon, tasks[0].specification)
        return Budget(config.budget_cents, config.budget_per or config.episodes, most)
    except BudgetError as error:
        raise SettingError("budget_cents", f"{error} (of {horizon} steps, as its file says)") from None


def said(budget: "Budget | None") -> dict[str, Any]:
    """What `run.json` says of a budget; nothing where there is none."""
    return {"budget": {"cents": budget.cents, "decisions": budget.decisions}} if budget is not None else {}
