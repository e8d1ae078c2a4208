"""What a live run's selector is told of its policies beforehand."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.api.run_settings import RunConfig

if TYPE_CHECKING:
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.encoder import Encoder
    from osel_sim.interface.suite import Task
    from osel_sim.selection.reward import RewardWeights


def declared(
    config: RunConfig, tasks: "Sequence[Task]", policies: "Sequence[PolicySpec]", weights: "RewardWeights", encoder: "Encoder"
) -> dict[str, Any]:
    """Settings by which a selector is told what policies declare, as far as it wants to know: what they cost, and what they were made for."""
    from osel_sim.episodes.declared_skills import declare
    from osel_sim.episodes.expected_costs import expected_costs
    from osel_sim.selection.registry import setting_names

    wanted, known = setting_names(config.selector), dict[str, Any]()
    if "expected_costs" in wanted:
        # Half of the horizon is about what a success takes; how costs differ from task to task is learned.
        actions = sum(task.info.horizon for task in tasks) // (2 * len(tasks))
        known["expected_costs"] = expected_costs(policies, weights, max(1, actions), tasks[0].specification)
    if "skills" in wanted:
        known["skills"] = declare(policies, encoder, tasks, config.tasks)
    return known
