"""Off-policy estimates of a live run as a table."""

from collections.abc import Mapping
from typing import Any

from osel_sim.analysis.estimate import Estimate
from osel_sim.reporting.html_tables import Cell, Column, Table


def off_policy_table(found: Mapping[str, Any]) -> Table:
    """What other ways of choosing would have earned in a live run.

    Args:
        found: as `osel_sim.analysis.evaluation.evaluate` returns it.
    """
    run = found["run"]
    received: dict[str, Cell] = dict.fromkeys(("ips", "snips"))
    received |= {"who": f"{run['selector']} (as it was)", "dr": _estimate(run, "mean_reward", "ci95"), "effective": float(run["decisions"])}
    rows: list[dict[str, Cell]] = [received]
    for name, entry in found["targets"].items():
        estimates = {key: _estimate(entry, key, f"{key}_ci95") for key in ("ips", "snips", "dr")}
        rows.append({"who": name.replace("fixed:", "always "), **estimates, "effective": float(entry["effective_decisions"])})
    columns = [
        *(Column("who", "way of choosing", "text"), Column("ips", "IPS", digits=3), Column("snips", "SNIPS", digits=3)),
        *(Column("dr", "doubly robust", digits=3), Column("effective", "effective decisions", digits=0)),
    ]
    caption = (
        "Mean reward a decision with 95% intervals, from the probabilities with which this run chose and the outcomes of what it chose alone. "
        "Greedy: the policy of the highest reward by a linear model of earlier decisions. A dash: the run could never have chosen so."
    )
    return Table("off_policy", "What other ways of choosing would have earned", caption, columns, rows)


def _estimate(entry: Mapping[str, Any], key: str, interval: str) -> Estimate | float | None:
    value, ends = entry[key], entry[interval]
    if value is None:
        return None
    return float(value) if ends is None else Estimate(float(value), float(ends[0]), float(ends[1]))
