"""What a rollout log says about its policies, as figures and tables."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from osel_sim.offline.contexts import lay_out
from osel_sim.offline.estimate import Estimate
from osel_sim.offline.log import LoggedOutcomes
from osel_sim.offline.outcomes import EVERYTHING, PolicyResult, outcome_rates, per_group
from osel_sim.reporting.description import CATEGORIES, Bars, Column, Figure, Line, Mark, Panel, Points, Table, colours
from osel_sim.reporting.episodes import shortened
from osel_sim.selection.reward import RewardWeights

PHASES = ("upload", "inference", "download", "motion")
_BINS = 40
_MOST_GROUPS = 14
"""So many groups are drawn side by side; of more, as the subjects of a large table, the commonest."""


def formula(weights: RewardWeights) -> str:
    """The reward in words."""
    score = "share of subgoals" if weights.success == "subgoals" else weights.success
    time = "steps" if weights.time_unit == "steps" else "log10(seconds)"
    return f"reward = {score} \u2212 {weights.alpha_time:g} · {time} \u2212 {weights.alpha_price:g} · cents"


def score_label(weights: RewardWeights) -> tuple[str, float]:
    """What the reward counts as success as the label of an axis, and by what to multiply it."""
    return {"success": ("success (%)", 100.0), "subgoals": ("subgoals done (%)", 100.0), "score": ("score", 1.0)}[weights.success]


def policy_blocks(log: LoggedOutcomes, weights: RewardWeights) -> list[Figure | Table]:
    """Success and reward of each policy by task, and by what was asked where the log knows (paper, figures 3 and 4)."""
    blocks: list[Figure | Table] = [
        _policy_table("policies", "Policies" if len(set(log.labels("task"))) == 1 else "Policies by task", per_group(log, weights, "task"))
    ]
    for attribute, word in (("task", "task"), ("target", "object asked for")):
        results = per_group(log, weights, attribute)
        if len({result.group for result in results}) == 1:
            continue
        blocks.append(_policy_figure(f"policies_by_{attribute}", f"Success and reward by {word}", results, log.policies))
        if attribute != "task":
            blocks.append(_policy_table(f"policies_by_{attribute}", f"Policies by {word}", results))
    if len(blocks) == 1:
        blocks.append(_policy_figure("policies_by_task", "Success and reward", per_group(log, weights, "task"), log.policies))
    return blocks


def rates_table(log: LoggedOutcomes, remote: NDArray[np.bool_], why: str) -> Table | None:
    """Table I of the paper; None where local and remote policies never ran on the same instance."""
    local = ", ".join(name for name, far in zip(log.policies, remote, strict=True) if not far)
    far = ", ".join(name for name, far in zip(log.policies, remote, strict=True) if far)
    cells = (("both", "both succeed"), ("only_local", "only local"), ("only_remote", "only remote"), ("neither", "neither"))
    found = [rates for rates in outcome_rates(log, remote) if rates.pairs]
    if not found:
        return None
    rows = [{"task": rates.group, "pairs": rates.pairs, **{key: getattr(rates, key) for key, _ in cells}} for rates in found]
    columns = [Column("task", "task", "text"), Column("pairs", "episodes of both"), *(Column(key, heading, "percent") for key, heading in cells)]
    caption = f"Local: {local}. Remote: {far}; it counts as a success if any of them succeeds ({why}). With 95% intervals. The paper's table I."
    return Table("outcome_rates", "Outcome rates of local and remote", caption, columns, rows)


def context_figure(log: LoggedOutcomes, weights: RewardWeights) -> Figure | None:
    """t-SNE of the contexts by everything that could explain how they lie."""
    layout = lay_out(log, weights)
    if layout is None:
        return None
    instructions = [shortened(instance.instruction or instance.key, 80) for instance in (log.instances[row] for row in layout.rows)]
    panels = []
    for aspect, labels in layout.labels.items():
        values = sorted(set(labels))
        colour = colours(values if aspect != "best policy" else [*log.policies, *(value for value in values if value not in log.policies)])
        marks: list[Mark] = []
        for number, value in enumerate(values):
            rows = np.array([label == value for label in labels])
            texts = [f"{text}: {value}" for text, own in zip(instructions, rows, strict=True) if own]
            x, y = layout.places[rows].T
            name = value if aspect == "best policy" else value.replace("_", " ")
            marks.append(Points(name, x, y, colour[value], texts, size=5, symbol="circle" if number < CATEGORIES else "x"))
        panels.append(Panel(f"by {aspect}", "", "", marks, bare=True))
    if not panels:
        return None
    caption = (
        f"Contexts of {len(layout.rows):,} instances laid out by t-SNE; encoder {log.encoder}. Points that lie together look alike to the selector: "
        "where they also share their best policy, context can help."
    )
    if {"several", "unknown"} & set(layout.labels.get("best policy", ())):
        caption += " Best policy: 'several' is a tie, 'unknown' a missing outcome."
    return Figure("contexts", "What the selector sees", caption, panels)


def time_figure(log: LoggedOutcomes) -> Figure | None:
    """Distributions of upload, inference, download and motion time (paper, appendix A)."""
    colour = colours(log.policies)
    panels = []
    for phase in PHASES:
        values = getattr(log, phase)
        known = [values[:, column][np.isfinite(values[:, column])] for column in range(len(log.policies))]
        used = [(policy, own) for policy, own in zip(log.policies, known, strict=True) if own.size and own.max() > 0.0]
        if not used:
            continue
        together = np.concatenate([own for _, own in used])
        edges = np.histogram_bin_edges(together, _bins(together.size))
        marks = [Line(policy, edges, [*(100 * np.histogram(own, edges)[0] / own.size), 0.0], colour[policy], steps=True) for policy, own in used]
        panels.append(Panel(phase, "seconds an episode", "episodes (%)", marks))
    if not panels:
        return None
    caption = "Sums over an episode, on the virtual clock. Policies without network take no time for upload or download, and are not drawn there."
    if np.isfinite(log.motion).any():
        caption += " The robot waits while an answer is on its way, so motion contains the other three."
    return Figure("times", "Where the time goes", caption, panels)


def _bins(count: int) -> int:
    """So many that a few episodes do not look like a comb."""
    return int(np.clip(2.0 * np.sqrt(count), 8, _BINS))


def _policy_table(name: str, title: str, results: Sequence[PolicyResult]) -> Table:
    keys = ("group", "policy", "instances", "episodes", "errors", "success", "reward", "steps", "seconds", "price")
    columns = [
        *(Column("group", "task" if "by_" not in name else "asked for", "text"), Column("policy", "policy", "text")),
        *(Column("instances", "instances"), Column("episodes", "episodes"), Column("errors", "errors")),
        *(Column("success", "success", "percent"), Column("reward", "mean reward", digits=3)),
        *(Column("steps", "steps", digits=0), Column("seconds", "seconds"), Column("price", "price (cents)", digits=1)),
    ]
    caption = "Means with 95% intervals: Wilson's for success, in which repeats of an instance count for what they tell; for the others a bootstrap "
    caption += "over instances. Errors count nowhere else."
    return Table(name, title, caption, columns, [{key: getattr(result, key) for key in keys} for result in results])


def _policy_figure(name: str, title: str, results: Sequence[PolicyResult], policies: Sequence[str]) -> Figure:
    groups = list(dict.fromkeys(result.group for result in results))
    size = {group: max(result.instances for result in results if result.group == group) for group in groups}
    shown = sorted(sorted(groups, key=lambda group: -size[group])[:_MOST_GROUPS], key=groups.index)
    colour = colours(policies)
    panels = []
    for measure, label in (("success", "success"), ("reward", "mean reward")):
        marks = []
        for policy in policies:
            own = {result.group: getattr(result, measure) for result in results if result.policy == policy}
            found: list[tuple[str, Estimate]] = [(group, own[group]) for group in shown if own.get(group) is not None]
            names = [group.replace("_", " ") if group != EVERYTHING else "all" for group, _ in found]
            values, low, high = ([getattr(estimate, end) for _, estimate in found] for end in ("value", "low", "high"))
            marks.append(Bars(policy, names, values, colour[policy], low, high))
        panels.append(Panel(label, "", label, marks, y_range=(0.0, 1.02) if measure == "success" else None))
    left_out = f" The {_MOST_GROUPS} with the most instances; the table has all." if len(shown) < len(groups) else ""
    caption = f"With 95% intervals. Where the order of the policies changes from group to group, there is something to route by.{left_out}"
    return Figure(name, title, caption, panels)
