"""What a rollout log says about its policies, as figures and tables."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.contexts import lay_out
from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.log import Array, LoggedOutcomes
from osel_sim.analysis.outcomes import EVERYTHING, PolicyResult, outcome_rates, per_group
from osel_sim.reporting.description import Bars, Column, Figure, Line, Mark, Panel, Points, Table, colours, shortened
from osel_sim.reporting.episodes import graded
from osel_sim.selection.reward import RewardWeights

PHASES = ("upload", "inference", "download", "motion")
_BINS = 40
_MOST_BARS = 14
"""So many groups are drawn as bars side by side; more, as the subjects of a large table, as a row each."""

_CLOUD_COLOURS = 12
"""The first colours differ enough to be told apart by single dots. With two symbols they are enough for twice as many groups."""


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
        _policy_table("policies", "Policies" if len(set(log.labels("task"))) == 1 else "Policies by task", per_group(log, weights, "task"), log)
    ]
    for attribute, word in (("task", "task"), ("robot", "robot"), ("target", "object asked for")):
        results = per_group(log, weights, attribute)
        if len({result.group for result in results}) == 1:
            continue
        blocks.append(_policy_figure(f"policies_by_{attribute}", f"Success and reward by {word}", results, log.policies))
        if attribute != "task":
            blocks.append(_policy_table(f"policies_by_{attribute}", f"Policies by {word}", results, log))
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
        own = colours([*log.policies, *sorted(set(labels) - set(log.policies))]) if aspect == "best policy" else None
        panels.append(Panel(f"by {aspect}", "", "", _clouds(layout.places, labels, instructions, own), bare=True))
    if not panels:
        return None
    caption = (
        f"Contexts of {len(layout.rows):,} instances laid out by t-SNE; encoder {log.encoder}. Points that lie together look alike to the selector: "
        "where they also share their best policy, context can help."
    )
    if {"several", "unknown"} & set(layout.labels.get("best policy", ())):
        caption += " Best policy: 'several' is a tie, 'unknown' a missing outcome."
    return Figure("contexts", "What the selector sees", caption, panels)


def _clouds(places: Array, labels: Sequence[str], texts: Sequence[str], own: Mapping[str, str] | None) -> list[Mark]:
    """Points (M, 2) by their labels; of more groups than can be told apart the largest, and the rest muted.

    Args:
        own: colour of each label, where these are policies, which have theirs everywhere.
    """
    sizes = Counter(labels)
    groups = sorted(sizes, key=lambda value: (-sizes[value], value))
    if own is None and len(groups) > 2 * _CLOUD_COLOURS:
        groups = groups[: _CLOUD_COLOURS - 1]
    rest = {f"{len(sizes) - len(groups)} others": set(sizes) - set(groups)} if len(groups) < len(sizes) else {}
    marks: list[Mark] = []
    # The muted rest comes first, below the others.
    for name, values in (rest | {value: {value} for value in sorted(groups)}).items():
        number = len(marks) - len(rest)
        colour = own[name] if own else "muted" if name in rest else f"c{number % _CLOUD_COLOURS}"
        rows = np.array([label in values for label in labels])
        about = [f"{text}: {label}" for text, label, inside in zip(texts, labels, rows, strict=True) if inside]
        x, y = places[rows].T
        symbol: Literal["circle", "x"] = "x" if own is None and number >= _CLOUD_COLOURS else "circle"
        marks.append(Points(name if own else name.replace("_", " "), x, y, colour, about, size=4 if name in rest else 5, symbol=symbol))
    return marks


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
    own = any(instance.seed is not None for instance in log.instances)
    caption = f"Sums over an episode{', on the virtual clock' if own else ', as the log has them'}."
    if own and {panel.title for panel in panels} & {"upload", "download"}:
        caption += " Policies without network take no time for upload or download, and are not drawn there."
    if own and np.isfinite(log.motion).any():
        caption += " The robot waits while an answer is on its way, so motion contains the other three."
    return Figure("times", "Where the time goes", caption, panels)


def _bins(count: int) -> int:
    """So many that a few episodes do not look like a comb."""
    return int(np.clip(2.0 * np.sqrt(count), 8, _BINS))


def _policy_table(name: str, title: str, results: Sequence[PolicyResult], log: LoggedOutcomes) -> Table:
    columns = [
        *(Column("group", "task" if "by_" not in name else "asked for", "text"), Column("policy", "policy", "text")),
        *(Column("instances", "instances"), Column("episodes", "episodes"), Column("errors", "errors")),
        Column("success", "success", "percent"),
        *([Column("subgoals", "subgoals", "percent")] if "subgoals" in graded(log) else []),
        *([Column("score", "score", digits=None)] if "score" in graded(log) else []),
        *(Column("reward", "mean reward", digits=3), Column("steps", "steps", digits=0)),
        *(Column("seconds", "seconds"), Column("price", "price (cents)", digits=None)),
    ]
    caption = "Means with 95% intervals: Wilson's for success, in which repeats of an instance count for what they tell; for the others a bootstrap "
    caption += "over instances. Errors count nowhere else."
    return Table(name, title, caption, columns, [{column.key: getattr(result, column.key) for column in columns} for result in results])


def _policy_figure(name: str, title: str, results: Sequence[PolicyResult], policies: Sequence[str]) -> Figure:
    groups = list(dict.fromkeys(result.group for result in results))
    if len(groups) > _MOST_BARS:
        return _policy_rows(name, title, results, policies)
    colour = colours(policies)
    panels = []
    for measure, label in (("success", "success"), ("reward", "mean reward")):
        marks = []
        for policy in policies:
            own = {result.group: getattr(result, measure) for result in results if result.policy == policy}
            found: list[tuple[str, Estimate]] = [(group, own[group]) for group in groups if own.get(group) is not None]
            names = [_group_name(group) for group, _ in found]
            values, low, high = ([getattr(estimate, end) for _, estimate in found] for end in ("value", "low", "high"))
            marks.append(Bars(policy, names, values, colour[policy], low, high))
        panels.append(Panel(label, "", label, marks, y_range=(0.0, 1.02) if measure == "success" else None))
    caption = "With 95% intervals. Where the order of the policies changes from group to group, there is something to route by."
    return Figure(name, title, caption, panels)


def _policy_rows(name: str, title: str, results: Sequence[PolicyResult], policies: Sequence[str]) -> Figure:
    """A row for each group; first those in which the best policy of all is behind another one."""
    found = {(result.group, result.policy): result for result in results}
    groups = [group for group in dict.fromkeys(result.group for result in results) if group != EVERYTHING]

    def reward(group: str, policy: str) -> float:
        mean = found[group, policy].reward
        return mean.value if mean is not None else np.nan

    best = max(policies, key=lambda policy: np.nan_to_num(reward(EVERYTHING, policy), nan=-np.inf))
    others = [policy for policy in policies if policy != best]
    # Of each group how far the best of all is ahead of the best other one; infinite, and so last, where there is none to compare with.
    ahead = {group: reward(group, best) - np.fmax.reduce([-np.inf, *(reward(group, policy) for policy in others)]) for group in groups}
    ahead = {group: value if np.isfinite(value) else np.inf for group, value in ahead.items()}
    rows = [EVERYTHING, *sorted(groups, key=lambda group: ahead[group])]
    names, colour = [_group_name(group) for group in rows], colours(policies)
    panels = []
    for measure, label in (("success", "success"), ("reward", "mean reward")):
        marks: list[Mark] = []
        for number, policy in enumerate(policies):
            known = [(row, estimate) for row, group in enumerate(rows) if (estimate := getattr(found[group, policy], measure)) is not None]
            values, low, high = ([getattr(estimate, end) for _, estimate in known] for end in ("value", "low", "high"))
            # A little apart, so that an interval does not cover another.
            y = [row + 0.6 * ((number + 0.5) / len(policies) - 0.5) for row, _ in known]
            ends = zip(known, values, low, high, strict=True)
            texts = [f"{names[row]}, {policy}: {value:.3f} [{start:.3f}, {end:.3f}]" for (row, _), value, start, end in ends]
            marks.append(Points(policy, values, y, colour[policy], texts, x_interval=(low, high), size=7))
        panels.append(Panel(label, "", "", marks, rows=names))
    behind = sum(value < 0.0 for value in ahead.values())
    caption = "With 95% intervals. "
    if others:
        caption += (
            f"Ordered by how far {best}, the best over all, is ahead of the best other policy in mean reward: in the first {behind} of {len(groups)} "
            "groups it is behind. Where it is so by more than the intervals, there is something to route by."
            if behind
            else f"Ordered by how far {best}, the best over all, is ahead of the best other policy in mean reward: it is in all {len(groups)} groups."
        )
    return Figure(name, title, caption, panels)


def _group_name(group: str) -> str:
    return group.replace("_", " ") if group != EVERYTHING else "all"
