"""Policies that joined or left a live run, as its page tells of them."""

import numpy as np

from osel_sim.analysis.estimate import mean_of, rate_of
from osel_sim.analysis.live import LiveLog
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.selection.reward import RewardWeights


def changes_table(live: LiveLog, weights: RewardWeights) -> Table:
    """What the selector received before each change and after it, up to the next one, and how often the policy was chosen since."""
    log, total = live.outcomes, len(live.chosen)
    at = [change.before for change in live.changes]
    rewards = log.mean_rewards(weights)
    rows: list[dict[str, Cell]] = []
    for change in live.changes:
        before = np.arange(max([0, *(other for other in at if other < change.before)]), min(change.before, total))
        after = np.arange(min(change.before, total), min([total, *(other for other in at if other > change.before)]))
        column = log.policies.index(change.policy)
        event = "joins" if change.event == "add" else "retires"
        row: dict[str, Cell] = {"before": change.before, "event": event, "policy": change.policy}
        for name, part in (("before", before), ("after", after)):
            chosen = part, live.chosen[part]
            row |= {f"success_{name}": rate_of(log.success[chosen]), f"reward_{name}": mean_of(rewards[chosen])}
        row["share"] = float((live.chosen[after] == column).mean()) if len(after) else None
        rows.append(row)
    columns = [
        *(Column("before", "before decision", digits=0), Column("event", "", "text"), Column("policy", "policy", "text")),
        *(Column("success_before", "success before", "percent"), Column("success_after", "success after", "percent")),
        *(
            Column("reward_before", "reward before", digits=3),
            Column("reward_after", "reward after", digits=3),
            Column("share", "chosen since", "percent"),
        ),
    ]
    told = "; ".join(change.words for change in live.changes)
    caption = f"{told}. Before: since the change before it; after: up to the next one. A policy that is not there has the propensity 0."
    return Table("changes", "Policies that joined or left", caption, columns, rows)
