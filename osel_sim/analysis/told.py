"""What selectors are told of a log before their stream begins: what policies cost, what they were made for, what a context consists of."""

from collections.abc import Sequence
from typing import Any

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.selection.registry import wanted_of
from osel_sim.selection.reward import RewardWeights

COSTS, SKILLS, PARTS = "expected_costs", "skills", "parts"
"""Settings of selectors that take them."""


def told(
    log: LoggedOutcomes, others: LoggedOutcomes, weights: RewardWeights, selectors: Sequence[str], costs: bool = True, skills: bool = True
) -> dict[str, dict[str, Any]]:
    """Selector -> the settings that it takes of these.

    Args:
        others: what costs are known from: the log's other half, or the log itself.
        costs, skills: whether those are told.
    """
    known: dict[str, Any] = {COSTS: others.expected_costs(weights)} if costs else {}
    if log.skills is not None and skills:
        known[SKILLS] = log.skills
    if log.parts:
        known[PARTS] = log.parts
    return {name: wanted_of(name, known) for name in selectors}
