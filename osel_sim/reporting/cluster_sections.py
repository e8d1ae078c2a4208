"""Section IV of the paper on a log, as figures and tables: clusters, what context is worth, trivial weights, frontiers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.clusters import Cluster, Clustering, Inequality, describe, find_clusters, inequality
from osel_sim.analysis.estimate import mean_of
from osel_sim.analysis.frontier import frontiers, measured
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.weights_map import Axis, TrivialRange, trivial_ranges, weights_map
from osel_sim.reporting.areas import regions, shares
from osel_sim.reporting.charts import Figure, Look, Panel, listed
from osel_sim.reporting.curves import Line, curves
from osel_sim.reporting.dots import Dot, Path, certain, rows, scatter
from osel_sim.reporting.html_tables import Cell, Column, Table, to_text
from osel_sim.reporting.log_sections import score_label
from osel_sim.reporting.palette import colours
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
        swept: what they came to at others, as `osel_sim.analysis.frontier.FrontierPlan` gives it; None where that was not replayed.
        look: of each.
    """

    points: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    swept: Mapping[str, Any] | None = None
    look: Look = field(default_factory=lambda: Look({}))


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
    return [_cluster_figure(log, routing), _cluster_table(log, routing), _inequality_table(routing)]


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
        for name, other in PRESETS.items()
        if other.time_unit == weights.time_unit and xs[0] <= other.alpha_time <= xs[-1] and ys[0] <= other.alpha_price <= ys[-1]
    }
    # The weights at hand first; a preset that is the same is not named a second time.
    here = (weights.alpha_time, weights.alpha_price)
    marked = {"these weights": here} | {
        name: (other.alpha_time, other.alpha_price) for name, other in inside.items() if (other.alpha_time, other.alpha_price) != here
    }
    near = np.outer(_within_a_decade(ys, weights.alpha_price), _within_a_decade(xs, weights.alpha_time))
    most = max(float(found.gain[near].max() if near.any() else found.gain.max()), 1e-3)
    panels = [
        regions("who serves the clusters", (x, y), xs, ys, 100 * found.remote_share, 100.0, "instances to a remote policy (%)", marked),
        regions("what routing by cluster adds", (x, y), xs, ys, found.gain, most, f"mean reward gained (up to {most:.2g} or more)", marked),
    ]
    caption = (
        "Left: all white and all dark are the paper's trivial regions, where every cluster wants a local or a remote policy. Right: best policy of "
        "each cluster minus best policy of all, chosen and scored on the same instances; with several remote policies choosing among them can pay "
        "where all want a remote one. Diamond: the weights of this report; dots: the paper's presets."
    )
    at = int(np.abs(np.log(xs / max(here[0], xs[0]))).argmin()), int(np.abs(np.log(ys / max(here[1], ys[0]))).argmin())
    text = (
        f"Two maps over alpha_time and alpha_price. At the weights of this report {100 * found.remote_share[at[1], at[0]]:.0f}% of the instances lie "
        f"in clusters best served by a remote policy, and routing by cluster adds {found.gain[at[1], at[0]]:.3f}."
    )
    return [Figure("weights_map", "When is routing trivial?", caption, text, panels, one_legend=False), _ranges_table(weights, routing.ranges)]


def frontier_figure(log: LoggedOutcomes, weights: RewardWeights, routing: Routing, replayed: Replayed) -> Figure | None:
    """Success against seconds and against price as a weight sweeps; None where the log has neither."""
    tables = {name: _policy_means(table) for name, table in measured(log, weights).items()}
    label, scale = score_label(weights)
    look = _frontier_look(log.policies, replayed)
    panels: list[Panel] = []
    for found in routing.ranges:
        against = "price" if found.axis == "alpha_price" else weights.clock
        x_label = "mean price (cents)" if against == "price" else f"mean {against}"
        other = "alpha_price" if found.axis == "alpha_time" else "alpha_time"
        paths: list[Path] = []
        for frontier in frontiers(log, routing.clustering.labels, weights, found.axis, found.limit):
            texts = [f"{found.axis} {value:.3g}" for value in frontier.weights]
            paths.append(Path(frontier.name, frontier.means[against], scale * frontier.means["score"], texts))
        dots = [
            Dot(f"always {policy}", certain(float(tables[against][column])), certain(float(scale * tables["score"][column])))
            for column, policy in enumerate(log.policies)
            if np.isfinite(tables[against][column])
        ]
        for name, values in replayed.points.items():
            paths += _swept(name, found.axis, against, scale, replayed)
            if against in values and "score" in values:
                dots.append(Dot(name, certain(values[against]), certain(scale * values["score"]), "these weights"))
        title = f"{found.axis} from 0 to {found.limit:.2g}, {other} = {getattr(weights, other):g}"
        panels.append(scatter(title, dots, look, (x_label, label), paths))
    if not panels:
        return None
    caption = (
        "Lines without a colour: what the hindsight oracle (dashed), and the best policy of each cluster (chosen on one half of the instances, "
        "scored on the other), come to as one weight sweeps. "
        "Diamonds: fixed policies. Up and to the left is better. Dots that coincide stand side by side."
    )
    if replayed.points:
        caption += " Selectors: the last quarter of their streams, a large dot at these weights."
    if replayed.swept:
        streams = f"{replayed.swept['seeds']} stream{'s' if replayed.swept['seeds'] > 1 else ''}"
        caption += f" Their lines: replayed at other weights, {streams} of {replayed.swept['decisions']:,} decisions at each."
    word = label.partition(" (")[0]
    means = [f"always {policy} {scale * value:.3g}" for policy, value in zip(log.policies, tables["score"], strict=True) if np.isfinite(value)]
    text = f"Curves of {label} against time and price as a weight sweeps, with a dot for each fixed policy: {listed(means)}."
    return Figure("frontier", f"Frontier: {word} against time and price", caption, text, panels, look.hidden)


def _frontier_look(policies: Sequence[str], replayed: Replayed) -> Look:
    own = colours(policies)
    oracles = {"hindsight oracle": "ink", "best policy of each cluster": "ink"}
    selectors = {name: replayed.look.colour.get(name, "muted") for name in replayed.points}
    fixed = {f"always {policy}": own[policy] for policy in policies}
    hidden = [name for name in replayed.points if name in replayed.look.hidden]
    return Look(oracles | selectors | fixed, {"hindsight oracle"}, dict.fromkeys(fixed, "diamond"), hidden)


def _swept(name: str, axis: Axis, against: str, scale: float, replayed: Replayed) -> list[Path]:
    """What a selector came to at other weights, where that was replayed."""
    swept = (replayed.swept or {}).get(axis)
    if not swept or name not in swept["selectors"]:
        return []
    line = {key: np.array(swept["selectors"][name][key], np.float64) for key in ("score", against)}  # None becomes NaN
    return [Path(name, line[against], scale * line["score"], [f"{axis} {value:.3g}" for value in swept["weights"]])]


def _cluster_figure(log: LoggedOutcomes, routing: Routing) -> Figure:
    names = [_cluster_name(cluster) for cluster in routing.clusters]
    rewards = {
        policy: {name: certain(cluster.rewards[policy]) for name, cluster in zip(names, routing.clusters, strict=True)} for policy in log.policies
    }
    parts = {"both": "both succeed", "only_local": "only local", "only_remote": "only remote", "neither": "neither"}
    rates = {label: [100 * getattr(cluster.rates, key).value for cluster in routing.clusters] for key, label in parts.items()}
    shades = dict(zip(parts.values(), ("good", "good_local", "good_remote", "bad"), strict=True))
    panels: list[Panel] = [
        rows("mean reward", names, rewards, Look(colours(log.policies)), "mean reward"),
        shares("outcome rates", names, rates, Look(shades), "episodes (%)"),
    ]
    scores = routing.clustering.silhouettes
    if len(scores) > 1:
        look = Look({"mean silhouette": "ink"})
        line = Line("mean silhouette", list(scores.values()))
        panels.append(curves(f"number of clusters: {routing.clustering.count} taken", list(scores), [line], look, ("clusters", "mean silhouette")))
    caption = "k-means in the leading components of the context, with the number of clusters of the highest silhouette. Largest cluster first."
    best = [f"{name}: {cluster.best}" for name, cluster in zip(names, routing.clusters, strict=True)]
    text = f"Dots of the mean reward of each policy, and bars of outcome rates, in each of {len(names)} clusters. Best policies: {listed(best)}."
    return Figure("clusters", "Clusters in the context", caption, text, panels, one_legend=False)


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
        "difference cannot be negative; held out, one half of the instances chooses and the other scores, so that it can. With a 95% interval. "
        + WHY_DIFFERENT
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
