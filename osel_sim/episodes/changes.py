"""Policies that join and leave a live run: what a selector is told when it goes through them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from osel_sim.formats.policy_changes import PolicyChange
from osel_sim.interface.selector import Selector
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.budget import Budgeted
from osel_sim.selection.changing import changing


@dataclass(frozen=True)
class PolicyChanges:
    """The changes of a run, those to come included.

    Attributes:
        made: in their order.
        told: for each of them, settings by which a selector is told what policies declare from then on (`SelectorBase.tell`).
    """

    made: tuple[PolicyChange, ...] = ()
    told: tuple[Mapping[str, Any], ...] = ()

    def apply(self, selector: Selector, index: int) -> tuple[PolicyChange, ...]:
        """Make the changes that come right before a decision. Returns them."""
        due = tuple(change for change in self.made if change.before == index)
        for change in due:
            told = self.told[self.made.index(change)] if self.told else {}
            apply(selector, change, told)
        return due


def apply(selector: Selector, change: PolicyChange, told: Mapping[str, Any]) -> None:
    """Let a selector have, or do without, a policy.

    Raises:
        UsageError: it cannot.
    """
    able = changing(selector, change.event == "retire")
    if change.event == "retire":
        able.retire_policy(change.policy)
        return
    within = selector.inner if isinstance(selector, Budgeted) else selector
    if told and isinstance(within, SelectorBase):
        within.tell(told)
    able.add_policy(change.policy)
