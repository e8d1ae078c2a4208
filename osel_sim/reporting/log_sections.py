"""What a rollout log says about its policies, as figures and tables."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.contexts import lay_out
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.outcomes import PolicyResult, outcome_rates, per_group
from osel_sim.reporting.charts import Figure, Look, listed
from osel_sim.reporting.curves import Line, curves
from osel_sim.reporting.dots import clouds, rows
from osel_sim.reporting.episodes import graded
from osel_sim.reporting.html_tables import Column, Table, shortened
from osel_sim.reporting.palette import CATEGORIES, colours
from osel_sim.reporting.routes import WORDS, estimates, ordered
from osel_sim.selection.reward import RewardWeights

FALLBACKS = Column("fallbacks", "fallbacks"), Column("solved_by_fallback", "solved by them")
CREDIT = "What a fallback solved from the first call on is no success of the policy."
"""Said below tables that have these columns."""

PHASES = ("upload", "inference", "download", "motion")
_BINS = 40
_MOST_LETTERS = 40
"""Of an instruction, in what the page says of a dot."""

_CLOUD_COLOURS = 12
"""The first colours differ enough to be told apart by single dots. With two shapes they are enough for twice as many groups."""


def formula(weights: RewardWeights) -> str:
    """The reward in words."""
    score = "share of subgoals" if weights.success == "subgoals" else weights.success
    return f"reward = {score} \u2212 {weights.alpha_time:g} · {weights.time_text} \u2212 {weights.alpha_price:g} · cents"


def score_label(weights: RewardWeights) -> tuple[str, float]:
    """What the reward counts as success as the label of an axis, and by what to multiply it."""
    return {"success": ("success (%)", 100.0), "subgoals": ("subgoals done (%)", 100.0), "score": ("score", 1.0)}[weights.success]


def policy_blocks(log: LoggedOutcomes, weights: RewardWeights) -> list[Figure | Table]:
    """Success and reward of each policy by task, and by what was asked where the log knows (paper, figures 3 and 4)."""
    several = len(set(log.labels("task"))) > 1
    title = "Policies by task" if several else "Policies"
    blocks: list[Figure | Table] = []
    for attribute, word in WORDS.items():
        results = per_group(log, weights, attribute)
        if attribute == "task":
            blocks.append(_policy_table("policies", title, results, log))
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
    if layout is None or not layout.labels:
        return None
    about = [shortened(instance.instruction or instance.key, _MOST_LETTERS) for instance in (log.instances[row] for row in layout.rows)]
    aspects = {}
    for aspect, labels in layout.labels.items():
        if aspect == "best policy":
            known = [policy for policy in log.policies if policy in labels]
            look, names = (
                Look({name: colours(log.policies)[name] for name in known} | dict.fromkeys(sorted(set(labels) - set(known)), "muted")),
                list(labels),
            )
        else:
            look, names = _groups([label or "(none)" for label in labels], len(log.policies))
        aspects[f"by {aspect}"] = (names, look)
    panels = clouds(layout.places, (about, layout.rows.tolist()), aspects)
    caption = (
        f"Contexts of {len(layout.rows):,} instances laid out by t-SNE; encoder {log.encoder}. Points that lie together look alike to the selector: "
        "where they also share their best policy, context can help. A click on one shows its episodes, if they are on the page."
    )
    if {"several", "unknown"} & set(layout.labels.get("best policy", ())):
        caption += " Best policy: 'several' is a tie, 'unknown' a missing outcome."
    sizes = [f"{aspect} ({len(set(labels))})" for aspect, labels in layout.labels.items()]
    text = f"{len(layout.rows):,} dots, one for each context, near one another where contexts are alike; coloured by {listed(sizes)} in turn."
    return Figure("contexts", "What the selector sees", caption, text, panels, one_legend=False)


def _groups(labels: Sequence[str], policies: int) -> tuple[Look, list[str]]:
    """How groups of dots are drawn, in colours that no policy has, and the name (n,) each dot goes by: of more groups than can be told apart the
    largest, and the rest muted.
    """
    sizes = Counter(labels)
    groups = sorted(sizes, key=lambda value: (-sizes[value], value))
    most = max(2, min(_CLOUD_COLOURS, CATEGORIES - policies))
    if len(groups) > 2 * most:
        groups = groups[: most - 1]
    rest = f"{len(sizes) - len(groups)} others"
    kept = sorted(groups)
    colour = {name: f"c{(policies + place % most) % CATEGORIES}" for place, name in enumerate(kept)}
    shapes = {name: "triangle-up" for name in kept[most:]}
    others = {rest: "muted"} if len(groups) < len(sizes) else {}
    return Look(colour | others, shapes=shapes), [label if label in colour else rest for label in labels]


def time_figure(log: LoggedOutcomes) -> Figure | None:
    """Distributions of upload, inference, download and motion time (paper, appendix A)."""
    panels, seconds = [], []
    look = Look(colours(log.policies))
    for phase in PHASES:
        values = getattr(log, phase)
        known = [values[:, column][np.isfinite(values[:, column])] for column in range(len(log.policies))]
        used = [(policy, own) for policy, own in zip(log.policies, known, strict=True) if own.size and own.max() > 0.0]
        if not used:
            continue
        together = np.concatenate([own for _, own in used])
        edges = np.histogram_bin_edges(together, _bins(together.size))
        lines = [Line(policy, [*(100 * np.histogram(own, edges)[0] / own.size), 0.0]) for policy, own in used]
        panels.append(curves(phase, edges, lines, look, ("seconds an episode", "episodes (%)"), steps=True))
        seconds.append(f"{phase} " + ", ".join(f"{policy} {own.mean():.2g}" for policy, own in used))
    if not panels:
        return None
    own = any(instance.seed is not None for instance in log.instances)
    caption = f"Sums over an episode{', on the virtual clock' if own else ', as the log has them'}."
    if own and any(text.startswith(("upload", "download")) for text in seconds):
        caption += " Policies without network take no time for upload or download, and are not drawn there."
    if own and np.isfinite(log.motion).any():
        caption += " The robot waits while an answer is on its way, so motion contains the other three."
    text = f"Histograms of seconds an episode by policy. Means: {listed(seconds)}."
    return Figure("times", "Where the time goes", caption, text, panels)


def _bins(count: int) -> int:
    """So many that a few episodes do not look like a comb."""
    return int(np.clip(2.0 * np.sqrt(count), 8, _BINS))


def _policy_table(name: str, title: str, results: Sequence[PolicyResult], log: LoggedOutcomes) -> Table:
    columns = [
        *(Column("group", "task" if "by_" not in name else "asked for", "text"), Column("policy", "policy", "text")),
        *(Column("instances", "instances"), Column("episodes", "episodes"), Column("errors", "errors")),
        *(FALLBACKS if log.fallbacks.any() else ()),
        Column("success", "success", "percent"),
        *([Column("subgoals", "subgoals", "percent")] if "subgoals" in graded(log) else []),
        *([Column("score", "score", digits=None)] if "score" in graded(log) else []),
        *(Column("reward", "mean reward", digits=3), Column("steps", "steps", digits=0)),
        *(Column("seconds", "seconds"), Column("price", "price (cents)", digits=None)),
    ]
    caption = "Means with 95% intervals: Wilson's for success, in which repeats of an instance count for what they tell; for the others a bootstrap "
    caption += "over instances. Errors count nowhere else." + (f" {CREDIT}" if log.fallbacks.any() else "")
    return Table(name, title, caption, columns, [{column.key: getattr(result, column.key) for column in columns} for result in results])


def _policy_figure(name: str, title: str, results: Sequence[PolicyResult], policies: Sequence[str]) -> Figure:
    """A row for each group; first those in which the best policy of all is behind another one."""
    groups, look = ordered(results, policies), Look(colours(policies))
    panels = [
        rows("success", groups.names, estimates(results, "success"), look, "success", percent=True),
        rows("mean reward", groups.names, estimates(results, "reward"), look, "mean reward"),
    ]
    count = len(groups.names) - 1
    caption = "With 95% intervals."
    if len(policies) > 1 and count:
        place = f"in the first {groups.behind} of {count} groups it is behind" if groups.behind else f"it is in all {count} groups"
        caption += (
            f" Ordered by how far {groups.best}, the best over all, is ahead of the best other policy in mean reward: {place}. "
            "Where another is ahead by more than the intervals, there is something to route by."
        )
    means = [f"{result.policy} {result.reward.value:.3f}" for result in results if result.group == groups.names[0] and result.reward is not None]
    text = f"Dots with intervals, a row for each of {count or 1} groups, a colour for each policy. Mean reward over all: {listed(means)}."
    return Figure(name, title, caption, text, panels)
