"""Off-policy estimates of decisions that were made, as a table and in a sentence."""

from collections.abc import Mapping
from typing import Any

from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.off_policy import LEAST_EFFECTIVE, WAYS
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Tile, Verdict


def off_policy_table(found: Mapping[str, Any]) -> Table:
    """What other ways of choosing would have earned in a live run.

    Args:
        found: as `osel_sim.analysis.evaluation.evaluate` returns it.
    """
    run = found["run"]
    nothing = {key: None for way in WAYS for key in (way, f"{way}_effective")}
    received = Estimate(float(run["mean_reward"]), float(run["ci95"][0]), float(run["ci95"][1]))
    rows: list[dict[str, Cell]] = [{"who": f"{run['selector']} (as it was)", "measured": received, **nothing}]
    for name, entry in found["targets"].items():
        estimates = {way: None if way in entry["few"] else _estimate(entry, way, f"{way}_ci95") for way in WAYS}
        effective = {f"{way}_effective": float(entry[f"{way}_effective"]) for way in WAYS}
        rows.append({"who": name.replace("fixed:", "always "), "measured": entry["measured"], **estimates, **effective})
    headings = {"ips": "IPS", "snips": "SNIPS", "dr": "doubly robust"}
    columns = [Column("who", "way of choosing", "text"), Column("measured", "measured", digits=3)]
    for way in WAYS:
        columns += [Column(way, headings[way], digits=3), Column(f"{way}_effective", "effective decisions", digits=0)]
    caption = (
        "Mean reward a decision with 95% intervals. Measured: from the outcomes themselves, where the run has them. Estimates: from the "
        "probabilities with which this run chose and the outcomes of what it chose alone, as if the others were not known. "
        f"Each has the number of decisions that it rests on; one that rests on fewer than {LEAST_EFFECTIVE:.0f} is not shown. "
        "IPS takes the mean weight for 1: where the run chose a policy more often than it meant to, IPS is too high by as much. "
        "Greedy: the policy of the highest reward by a linear model of earlier decisions. A dash: too few, or the run could never have chosen so."
    )
    return Table("off_policy", "What other ways of choosing would have earned", caption, columns, rows)


def off_policy_verdict(found: Mapping[str, Any]) -> Verdict:
    """What a page of logged decisions says first: what was earned, and what the best single policy is estimated to earn (doubly robust)."""
    run, targets = found["run"], found["targets"]
    earned = f"{run['mean_reward']:.3f} a decision was earned by {run['selector']}, in {run['decisions']} decisions"
    known = {name: entry for name, entry in targets.items() if name.startswith("fixed:") and entry["dr"] is not None}
    if not known:
        return Verdict("What was chosen is all that is known", [f"{earned}. No other way of choosing can be estimated from it."])
    name = max(known, key=lambda target: known[target]["dr"])
    policy, value, ends = name.removeprefix("fixed:"), known[name]["dr"], known[name]["dr_ci95"]
    between = "" if ends is None else f", between {ends[0]:.3f} and {ends[1]:.3f}"
    tiles = [Tile("earned", f"{run['mean_reward']:.3f}", "mean reward a decision"), Tile(f"always {policy}", f"{value:.3f}", "estimated")]
    return Verdict(
        f"Always {policy} is estimated to earn {value:.3f}",
        [f"{earned}; always {policy} is estimated to earn {value:.3f}{between} (95%), the most of any single policy."],
        tiles,
    )


def _estimate(entry: Mapping[str, Any], key: str, interval: str) -> Estimate | float | None:
    value, ends = entry[key], entry[interval]
    if value is None:
        return None
    return float(value) if ends is None else Estimate(float(value), float(ends[0]), float(ends[1]))
