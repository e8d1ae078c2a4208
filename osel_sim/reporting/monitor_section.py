"""What a monitor made of a live run's episodes: who drove when, what each policy had of it, and what the same choices come to without it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from osel_sim.analysis.estimate import mean_of, rate_of
from osel_sim.analysis.live import LiveLog
from osel_sim.formats.journal import Decision
from osel_sim.interface.outcome import Driving, Monitored
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Section
from osel_sim.reporting.who_drove import Drive, parts_of, who_drove
from osel_sim.selection.reward import RewardWeights

MOST = 60
"""Rows of the figure, of the run's last episodes."""

_Watched = tuple[Decision, Monitored]


def monitor_sections(live: LiveLog, weights: RewardWeights) -> list[Section]:
    """The section of a run that a monitor watched; none of another.

    Args:
        weights: of the run's reward.
    """
    watched = [(decision, decision.monitored) for decision in live.decisions if decision.monitored is not None]
    if not watched:
        return []
    shown = watched[-MOST:]
    drives = [_drive(decision, told) for decision, told in shown]
    which = f"the last {len(shown)} of {len(watched)} episodes" if len(shown) < len(watched) else f"{len(watched)} episode{'s' * (len(watched) > 1)}"
    handed = sum(bool(told.handoffs) for _, told in shown)
    caption = f"{which[0].upper()}{which[1:]} in the order of the run, a row each; {handed} of them were handed over."
    return [
        Section("handoffs", "Handing over", [who_drove(drives, live.outcomes.policies, caption), _driving(watched), _with_and_without(live, weights)])
    ]


def _drive(decision: Decision, told: Monitored) -> Drive:
    ends = "error" if decision.error is not None else "solved" if decision.success else "not solved"
    why = "; ".join(f"to {one.to} at step {one.step}: {one.why}" for one in told.handoffs)
    about = f"{decision.index}, {decision.instance}: {ends}" + (f"; {why}" if why else "")
    handoffs = [(one.step, one.to) for one in told.handoffs]
    return Drive(decision.task, about, None if decision.error is not None else decision.success, parts_of(decision.policy, handoffs, decision.steps))


def _driving(watched: Sequence[_Watched]) -> Table:
    """What each policy had of the episodes."""
    told = [one for decision, one in watched if decision.error is None]
    rows: list[dict[str, Cell]] = []
    for policy in sorted({policy for one in told for policy in one.by_policy}):
        own = [one.by_policy.get(policy, Driving(0, 0, 0, 0.0)) for one in told]
        rows.append(
            {
                "policy": policy,
                "began": sum(decision.policy == policy for decision, _ in watched if decision.error is None),
                "took": sum(handoff.to == policy for one in told for handoff in one.handoffs),
                "steps": sum(one.steps for one in own) / max(sum(one.steps for each in told for one in each.by_policy.values()), 1),
                "calls": sum(one.calls for one in own) / max(sum(one.calls for each in told for one in each.by_policy.values()), 1),
                "price": mean_of(np.array([one.price for one in own])),
            }
        )
    columns = [
        *(Column("policy", "policy", "text"), Column("began", "began", digits=0), Column("took", "took over", digits=0)),
        *(Column("steps", "of the steps", "percent"), Column("calls", "of the calls", "percent"), Column("price", "cents an episode", digits=None)),
    ]
    return Table("driving", "What each policy had of the episodes", "A fallback's steps are its own.", columns, rows)


def _with_and_without(live: LiveLog, weights: RewardWeights) -> Table:
    """What was received, and of the same first policies without the monitor where that is known: duty against success."""
    decisions = [decision for decision in live.decisions if decision.monitored is not None and decision.error is None]
    at = np.array([decision.index for decision in decisions], np.int64)
    steps = max(sum(decision.steps for decision in decisions), 1)
    duty = sum(decision.monitored.duty_steps * decision.steps for decision in decisions if decision.monitored is not None) / steps
    received = {"success": np.array([[float(decision.success)] for decision in decisions]), "price": [decision.price for decision in decisions]}
    received["reward"] = [np.nan if decision.reward is None else decision.reward for decision in decisions]
    rows = [_measured("with the monitor", received) | {"duty": duty}]
    compared = live.has_all_outcomes(weights)  # then the log has of the chosen policies what they come to alone
    if compared:
        log, chosen = live.outcomes, live.chosen[at]
        alone = {"success": log.success[at, chosen], "price": log.price[at, chosen], "reward": log.mean_rewards(weights)[at, chosen]}
        rows.append(_measured("the same choices without it", alone) | {"duty": None})
    columns = [
        *(Column("who", "", "text"), Column("duty", "duty", "percent"), Column("success", "success", "percent")),
        *(Column("reward", "mean reward", digits=3), Column("price", "cents an episode", digits=None)),
    ]
    caption = "Duty: the share of the control steps that remote policies drove. "
    caption += "With 95% intervals." if compared else "What the same choices come to without the monitor is known of a run with --counterfactual."
    return Table("monitored", "With the monitor and without", caption, columns, rows)


def _measured(who: str, values: Mapping[str, Any]) -> dict[str, Cell]:
    return {"who": who, "success": rate_of(values["success"]), "reward": mean_of(values["reward"]), "price": mean_of(values["price"])}
