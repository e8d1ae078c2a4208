"""Section IV of the paper on a log, as figures and tables: clusters, what context is worth, trivial weights, frontiers."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.clusters import Cluster, Clustering, Inequality, describe, find_clusters, inequality
from osel_sim.analysis.estimate import mean_of
from osel_sim.analysis.frontier import frontiers, measured
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.weights_map import Axis, TrivialRange, trivial_ranges, weights_map
from osel_sim.reporting.description import Bars, Cell, Column, Figure, Heat, Line, Mark, Panel, Points, Table, colours
from osel_sim.reporting.html_tables import to_text
from osel_sim.reporting.log_sections import score_label
from osel_sim.selection.reward import PRESETS, RewardWeights

WHY_DIFFERENT = (
    "The paper's formula gives the local side 1 \u2212 p_FS, which counts what both fail as local successes and charges local no time, and gives the "
    "remote side p_FS alone, which leaves out what both solve; the plain expectation is the mean reward of each policy."
)


@dataclass(frozen=True)
class Replayed:
    """What the frontier shows of selectors.

    Attributes:
        points: of each at the weights given, as `osel_sim.analysis.frontier.measured` names it.
        swept: what they came to at others, as `osel_sim.analysis.frontier.selector_frontiers` gives it; None where that was not replayed.
        colour: of each.
        shown: those drawn without being asked for.
    """

    points: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    swept: Mapping[str, Any] | None = None
    colour: Mapping[str, str] = field(default_factory=dict)
    shown: Collection[str] = ()


class Routing(NamedTuple):
    """The clusters of a log and what they are worth."""

    clustering: Clustering
    clusters: list[Cluster]
    inequality: Inequality
    ranges: list[TrivialRange]


def analyse(log: LoggedOutcomes, weights: RewardWeights, remote: NDArray[np.bool_]) -> Routing:
    """Find the clusters and say what they are worth.

    Raises:
        DataError: too few instances for clusters, or none with an outcome of every policy.
    """
    clustering = find_clusters(log.contexts)
    return Routing(
        clustering,
        describe(log, clustering, weights, remote),
        inequality(log, clustering.labels, weights, remote),
        trivial_ranges(log, clustering.labels, weights, remote),
    )


def cluster_blocks(log: LoggedOutcomes, routing: Routing) -> list[str | Figure | Table]:
    """Clusters with their outcome rates and optimal actions, and the paper's inequality."""
    return [_cluster_figure(log, routing), _cluster_table(log, routing), _inequality_table(routing), WHY_DIFFERENT]


def weights_blocks(log: LoggedOutcomes, weights: RewardWeights, remote: NDArray[np.bool_], routing: Routing) -> list[str | Figure | Table]:
    """Where routing is trivial, as a map over both weights and as ranges of each."""
    if not routing.ranges:
        return ["The log has neither times nor prices of every policy, so there is nothing to weigh success against."]
    found = weights_map(log, routing.clustering.labels, weights, remote)
    if found is None:
        return [_ranges_table(weights, routing.ranges)]
    x, y, xs, ys = "alpha_time", "alpha_price (per cent)", found.alpha_time, found.alpha_price
    inside = {
        name: other
        for name, other in {**PRESETS, "these weights": weights}.items()
        if other.time_unit == weights.time_unit and xs[0] <= other.alpha_time <= xs[-1] and ys[0] <= other.alpha_price <= ys[-1]
    }
    points: list[Mark] = [
        Points(name, [other.alpha_time], [other.alpha_price], "ink", size=13, symbol="star", labelled=True)
        if name == "these weights"
        else Points(name, [other.alpha_time], [other.alpha_price], "ink", size=9, symbol="diamond", labelled=True)
        for name, other in inside.items()
        if name == "these weights" or (other.alpha_time, other.alpha_price) != (weights.alpha_time, weights.alpha_price)
    ]
    near = np.outer(_within_a_decade(ys, weights.alpha_price), _within_a_decade(xs, weights.alpha_time))
    most = max(float(found.gain[near].max() if near.any() else found.gain.max()), 1e-3)
    who = Heat("instances to a remote policy (%)", xs, ys, 100 * found.remote_share, "diverging", 0, 100)
    gain = Heat(f"mean reward gained (up to {most:.2g} or more)", xs, ys, found.gain, "sequential", 0, most)
    panels = [
        Panel("who serves the clusters", x, y, [who, *points], True, True),
        Panel("what routing by cluster adds", x, y, [gain, *points], True, True),
    ]
    caption = (
        "Left: all blue and all red are the paper's trivial regions, where every cluster wants a local or a remote policy. Right: best policy of "
        "each cluster minus best policy of all, chosen and scored on the same instances; with several remote policies choosing among them can pay "
        "where all want a remote one. Star: the weights of this report; diamonds: the paper's presets."
    )
    return [Figure("weights_map", "When is routing trivial?", caption, panels), _ranges_table(weights, routing.ranges)]


def frontier_figure(log: LoggedOutcomes, weights: RewardWeights, routing: Routing, replayed: Replayed) -> Figure | None:
    """Success against seconds and against price as a weight sweeps; None where the log has neither."""
    tables = {name: _policy_means(table) for name, table in measured(log, weights).items()}
    own, label, scale = colours(log.policies), *score_label(weights)
    panels = []
    for found in routing.ranges:
        against = "price" if found.axis == "alpha_price" else "steps" if weights.time_unit == "steps" else "seconds"
        x_label = "mean price (cents)" if against == "price" else f"mean {against}"
        other = "alpha_price" if found.axis == "alpha_time" else "alpha_time"
        marks: list[Mark] = []
        for frontier, dash in zip(frontiers(log, routing.clustering.labels, weights, found.axis, found.limit), (True, False), strict=False):
            x, texts = frontier.means[against], [f"{found.axis} {value:.3g}" for value in frontier.weights]
            marks.append(Line(frontier.name, x, scale * frontier.means["score"], "ink", dash=dash, dots=True, texts=texts))
        for column, policy in enumerate(log.policies):
            if np.isfinite(tables[against][column]):
                marks.append(
                    Points(f"always {policy}", [tables[against][column]], [scale * tables["score"][column]], own[policy], size=11, symbol="diamond")
                )
        for name in replayed.points:
            marks += _selector_marks(name, found.axis, against, scale, replayed)
        title = f"{found.axis} from 0 to {found.limit:.2g}, {other} = {getattr(weights, other):g}"
        panels.append(Panel(title, x_label, label, marks))
    if not panels:
        return None
    caption = (
        "Black: what the hindsight oracle (dashed), and the best policy of each cluster (chosen on one half of the instances, scored on the other), "
        "come to as one weight sweeps. Up and to the left is better."
    )
    if replayed.points:
        caption += " Selectors: the last quarter of their streams, a large dot at these weights."
    if replayed.swept:
        streams = f"{replayed.swept['seeds']} stream{'s' if replayed.swept['seeds'] > 1 else ''}"
        caption += f" Their lines: replayed at other weights, {streams} of {replayed.swept['decisions']:,} decisions at each."
    return Figure("frontier", f"Frontier: {label.partition(' (')[0]} against time and price", caption, panels)


def _selector_marks(name: str, axis: Axis, against: str, scale: float, replayed: Replayed) -> list[Mark]:
    """A selector on the frontier: a line where it was replayed at other weights, and a dot at these."""
    colour, shown, values = replayed.colour.get(name, "muted"), name in replayed.shown, replayed.points[name]
    marks: list[Mark] = []
    swept = (replayed.swept or {}).get(axis)
    if swept and name in swept["selectors"]:
        line = {key: np.array(swept["selectors"][name][key], np.float64) for key in ("score", against)}  # None becomes NaN
        texts = [f"{name}, {axis} {value:.3g}" for value in swept["weights"]]
        marks.append(Line(name, line[against], scale * line["score"], colour, dots=True, texts=texts, shown=shown))
    if against in values and "score" in values:
        marks.append(Points(name, [values[against]], [scale * values["score"]], colour, size=9, shown=shown))
    return marks


def _cluster_figure(log: LoggedOutcomes, routing: Routing) -> Figure:
    names = [_cluster_name(cluster) for cluster in routing.clusters]
    colour = colours(log.policies)
    rewards: list[Mark] = [Bars(policy, names, [cluster.rewards[policy] for cluster in routing.clusters], colour[policy]) for policy in log.policies]
    parts = (
        ("both", "both succeed", "c2"),
        ("only_local", "only local", "c0"),
        ("only_remote", "only remote", "c1"),
        ("neither", "neither", "muted"),
    )
    rates: list[Mark] = [
        Bars(label, names, [100 * getattr(cluster.rates, key).value for cluster in routing.clusters], shade) for key, label, shade in parts
    ]
    scores = routing.clustering.silhouettes
    best = routing.clustering.count
    search: list[Mark] = [
        Line("silhouette", list(scores), list(scores.values()), "c4"),
        Points("taken", [best], [scores[best]] if best in scores else [max(scores.values())], "c1", size=11, symbol="star"),
    ]
    panels = [
        Panel("mean reward", "", "mean reward", rewards),
        Panel("outcome rates", "", "episodes (%)", rates, stacked=True, y_range=(0.0, 100.0)),
        Panel("number of clusters", "clusters", "mean silhouette", search),
    ]
    caption = "k-means in the leading components of the context, with the number of clusters of the highest silhouette. Largest cluster first."
    return Figure("clusters", "Clusters in the context", caption, panels)


def _cluster_table(log: LoggedOutcomes, routing: Routing) -> Table:
    policies = list(log.policies)
    rows: list[dict[str, Cell]] = [
        {
            **{"cluster": cluster.number, "about": cluster.about, "instances": cluster.instances, "share": cluster.share},
            **{f"p_{key}": getattr(cluster.rates, key).value for key in ("both", "only_local", "only_remote", "neither")},
            **{f"reward_{policy}": cluster.rewards[policy] for policy in policies},
            "best": cluster.best,
            **{
                "paper_local": cluster.paper_local,
                "paper_remote": cluster.paper_remote,
                "paper_best": "remote" if cluster.paper_remote_best else "local",
            },
        }
        for cluster in routing.clusters
    ]
    columns = [
        *(Column("cluster", "cluster"), Column("about", "mostly", "text"), Column("instances", "instances"), Column("share", "share ρ", "percent")),
        *(Column("p_both", "p_SS", "percent"), Column("p_only_local", "p_SF", "percent"), Column("p_only_remote", "p_FS", "percent")),
        Column("p_neither", "p_FF", "percent"),
        *(Column(f"reward_{policy}", f"reward of {policy}", digits=3) for policy in policies),
        Column("best", "optimal action", "text"),
        *(Column("paper_local", "paper: 1 \u2212 p_FS", digits=3), Column("paper_remote", "paper: p_FS \u2212 penalties", digits=3)),
        Column("paper_best", "paper: action", "text"),
    ]
    caption = "Outcome rates: first letter local, second remote, S success, F failure. Only instances on which every policy has an outcome."
    return Table("clusters", "Optimal action of each cluster", caption, columns, rows)


def _inequality_table(routing: Routing) -> Table:
    found = routing.inequality
    columns = [
        *(
            Column("formula", "computed as", "text"),
            Column("contextual", "contextual", digits=4),
            Column("non_contextual", "non-contextual", digits=4),
        ),
        Column("difference", "difference", digits=4),
    ]
    rows: list[dict[str, Cell]] = [
        {
            "formula": "plain expectation, same instances",
            **{"contextual": found.contextual, "non_contextual": found.non_contextual, "difference": found.size},
        },
        {"formula": "plain expectation, held out", "contextual": None, "non_contextual": None, "difference": found.held_out},
        {
            "formula": "paper's formula (1 \u2212 p_FS)",
            **{"contextual": found.paper_contextual, "non_contextual": found.paper_non_contextual},
            "difference": found.paper_contextual - found.paper_non_contextual,
        },
    ]
    caption = (
        "Converged mean reward of the best policy of each cluster against the best policy of all (paper, section IV). On the same instances the "
        "difference cannot be negative; held out, one half of the instances chooses and the other scores, so that it can. With a 95% interval."
    )
    return Table("inequality", "What context is worth once all is learnt", caption, columns, rows)


def _ranges_table(weights: RewardWeights, ranges: list[TrivialRange]) -> Table:
    number = Column("", "", digits=4)
    rows: list[dict[str, Cell]] = []
    for found in ranges:
        other = "alpha_price" if found.axis == "alpha_time" else "alpha_time"
        alone = [f"{policy}: {to_text(low, number)} to {to_text(high, number)}" for policy, low, high in found.one_policy]
        for formula, below, above in (
            ("plain expectation", found.all_remote_below, found.all_local_above),
            ("paper's formula (1 \u2212 p_FS)", found.paper_all_remote_below, found.paper_all_local_above),
        ):
            rows.append(
                {
                    **{"weight": found.axis, "here": float(getattr(weights, found.axis)), "kept": f"{other} = {getattr(weights, other):g}"},
                    **{"formula": formula, "remote": "never" if below is None else f"0 to {to_text(below, number)}"},
                    "local": f"not up to {found.limit:.3g}" if above is None else f"from {to_text(above, number)}",
                    "alone": "" if formula != "plain expectation" else "; ".join(alone) or "nowhere",
                }
            )
    columns = [
        *(Column("weight", "weight", "text"), Column("here", "in this report", digits=4), Column("kept", "other weight kept at", "text")),
        *(Column("formula", "computed as", "text"), Column("remote", "every cluster remote", "text"), Column("local", "every cluster local", "text")),
        Column("alone", "same policy in every cluster", "text"),
    ]
    caption = (
        "Between the first two ranges some clusters want a local and some a remote policy. A contextual selector has nothing to gain only where one "
        "and the same policy is best in every cluster: with several remote policies that is less than where all are remote."
    )
    return Table("trivial_weights", "Ranges in which routing is trivial", caption, columns, rows)


def _policy_means(values: Array) -> Array:
    """Mean of each policy, (P,), of what is known; NaN of nothing."""
    means = [mean_of(mean_over_repeats(values[:, column])) for column in range(values.shape[1])]
    return np.array([np.nan if mean is None else mean.value for mean in means])


def _within_a_decade(values: Array, of: float) -> NDArray[np.bool_]:
    return (values >= of / 10.0) & (values <= of * 10.0)


def _cluster_name(cluster: Cluster) -> str:
    about = cluster.about.split(" (")[0]
    return f"{cluster.number}" if about == "mixed" else f"{cluster.number} {about}"
