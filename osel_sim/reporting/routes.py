"""What goes where: success of each policy on each task, and which policy is chosen there, as heatmaps. The first figure of a page."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.outcomes import EVERYTHING, PolicyResult, per_group
from osel_sim.reporting.areas import Cell, heatmap
from osel_sim.reporting.charts import Figure, Look, Panel, listed
from osel_sim.reporting.palette import colours
from osel_sim.selection.reward import RewardWeights

_MOST_ROWS = 11
"""Groups on the first screen; the figure of the policies has them all."""

WORDS = {"task": "task", "robot": "robot", "target": "object asked for"}
"""Attributes of an instance that a page goes by, as it calls them."""


@dataclass(frozen=True)
class Chosen:
    """Which policies were chosen for which instances.

    Attributes:
        who: chose.
        instances: (S, T) of S streams of T decisions.
        columns: (S, T) of the policy chosen.
        when: which decisions these are.
    """

    who: str
    instances: NDArray[np.int64]
    columns: NDArray[np.int64]
    when: str


@dataclass(frozen=True)
class Groups:
    """Groups of instances in the order in which they are shown: all of them, then those in which the best policy of all is furthest behind.

    Attributes:
        names: `all`, then the groups.
        best: the policy with the highest mean reward over all.
        behind: in how many groups another policy has a higher one.
    """

    names: Sequence[str]
    best: str
    behind: int


def attribute_of(log: LoggedOutcomes) -> str:
    """What tells the instances of a log apart: their task where there are several, else the object asked for."""
    return "task" if len(set(log.labels("task"))) > 1 or len(set(log.labels("target"))) < 2 else "target"


def ordered(results: Sequence[PolicyResult], policies: Sequence[str]) -> Groups:
    """The groups of `per_group`."""
    found = {(result.group, result.policy): result.reward.value if result.reward is not None else np.nan for result in results}
    groups = [group for group in dict.fromkeys(result.group for result in results) if group != EVERYTHING]
    best = max(policies, key=lambda policy: np.nan_to_num(found[EVERYTHING, policy], nan=-np.inf))
    others = [policy for policy in policies if policy != best]
    # Infinite, and so last, where there is none to compare with.
    ahead = {group: found[group, best] - np.fmax.reduce([-np.inf, *(found[group, policy] for policy in others)]) for group in groups}
    ahead = {group: value if np.isfinite(value) else np.inf for group, value in ahead.items()}
    names = [EVERYTHING, *sorted(groups, key=lambda group: ahead[group])]
    return Groups(names, best, sum(value < 0.0 for value in ahead.values()))


def route_figure(log: LoggedOutcomes, weights: RewardWeights, chosen: Chosen | None = None) -> Figure:
    """Success of each policy by task (or object asked for), beside it who was chosen there; of a log, in which nobody chose, the mean reward."""
    attribute = attribute_of(log)
    results = per_group(log, weights, attribute)
    groups = ordered(results, log.policies)
    rows = groups.names[: _MOST_ROWS + 1]
    kept = [result for result in results if result.group in rows]
    kept.sort(key=lambda result: rows.index(result.group))
    look = Look(dict.fromkeys(log.policies, "good"))
    panels: list[Panel] = [heatmap("success", [_success(result) for result in kept], look)]
    if chosen is not None:
        shares = chosen_shares(chosen, log, attribute, rows)
        cells = [_share(row, policy, shares[row].get(policy)) for row in rows if row in shares for policy in log.policies]
        panels.append(heatmap(f"{chosen.who} chose", cells, Look(colours(log.policies))))
    else:
        panels.append(heatmap("mean reward", _rewards(kept), Look(dict.fromkeys(log.policies, "ink"))))
    word = WORDS[attribute]
    caption = f"By {word}; first where {groups.best}, the best over all, is furthest behind another policy. "
    if len(groups.names) > len(rows):
        caption += f"{len(rows) - 1} of {len(groups.names) - 1}: the others are below under Policies. "
    caption += (
        f"Right: share of the decisions{chosen.when}." if chosen is not None else "Where the best policy changes, there is something to route by."
    )
    return Figure("routes", "What goes where", caption, _alternative(kept, rows, chosen, word), panels, one_legend=False)


def chosen_shares(chosen: Chosen, log: LoggedOutcomes, attribute: str, rows: Sequence[str]) -> dict[str, dict[str, tuple[float, int]]]:
    """Group -> policy -> (share of the decisions on it, how many decisions that is of); groups that were never decided on are missing."""
    labels = np.array([label or "(none)" for label in log.labels(attribute)])[chosen.instances]
    found: dict[str, dict[str, tuple[float, int]]] = {}
    for row in rows:
        mine = chosen.columns[(labels == row) | (row == EVERYTHING)]
        if mine.size:
            found[row] = {policy: (float((mine == column).mean()), int(mine.size)) for column, policy in enumerate(log.policies)}
    return found


def estimates(results: Sequence[PolicyResult], measure: str) -> dict[str, dict[str, Estimate]]:
    """Policy -> group -> estimate of a measure of `per_group`, where there is one."""
    found: dict[str, dict[str, Estimate]] = {result.policy: {} for result in results}
    for result in results:
        if (estimate := getattr(result, measure)) is not None:
            found[result.policy][result.group] = estimate
    return found


def _success(result: PolicyResult) -> Cell:
    if result.success is None:
        return Cell(result.group, result.policy, 0.0, "–", "no outcome")
    value, low, high = (100 * end for end in (result.success.value, result.success.low, result.success.high))
    return Cell(result.group, result.policy, value / 100, f"{value:.0f}%", f"{value:.0f}% [{low:.0f}, {high:.0f}], {result.instances:,} instances")


def _share(row: str, policy: str, found: tuple[float, int] | None) -> Cell:
    share, count = found or (0.0, 0)
    return Cell(row, policy, share, f"{100 * share:.0f}%", f"{100 * share:.0f}% of {count:,} decisions")


def _rewards(results: Sequence[PolicyResult]) -> list[Cell]:
    """Shaded from the lowest to the highest of them."""
    known = [result.reward.value for result in results if result.reward is not None]
    low, span = min(known, default=0.0), (max(known) - min(known) if known else 0.0) or 1.0
    cells = []
    for result in results:
        if result.reward is None:
            cells.append(Cell(result.group, result.policy, 0.0, "–", "no outcome"))
            continue
        reward = result.reward
        text = f"{round(reward.value, 3) + 0.0:.3f}".replace("-", "\u2212")  # no negative zero
        cells.append(
            Cell(result.group, result.policy, (reward.value - low) / span, text, f"{reward.value:.3f} [{reward.low:.3f}, {reward.high:.3f}]")
        )
    return cells


def _alternative(results: Sequence[PolicyResult], rows: Sequence[str], chosen: Chosen | None, word: str) -> str:
    parts = []
    for row in rows:
        own = [result for result in results if result.group == row and result.success is not None]
        if own:
            best = max(own, key=lambda result: result.success.value if result.success else 0.0)
            parts.append(f"{row}: {best.policy} {100 * best.success.value:.0f}%" if best.success else row)
    text = f"Heatmap of success, a row for each {word}, a column for each policy. Highest in each row: {listed(parts, _MOST_ROWS + 1)}."
    return text + (f" Beside it the share in which {chosen.who} chose each policy." if chosen is not None else " Beside it the mean reward.")
