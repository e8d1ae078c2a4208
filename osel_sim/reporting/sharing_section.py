"""What sharing is worth to several robots, on the pages of replays and live runs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.sharing_words import about, conclusion, title
from osel_sim.reporting.charts import Figure, Look, Panel
from osel_sim.reporting.curves import Line, curves, settled_domain
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Section

_MOST_PANELS = 6


def sharing_sections(result: Mapping[str, Any]) -> list[Section]:
    """The section of a replay to several robots; none where there was one.

    Args:
        result: of `replay.json`.
    """
    sharing = result.get("sharing")
    return [] if not sharing else [Section("sharing", "Robots that share", [sharing_figure(sharing), sharing_table(sharing)])]


def sharing_figure(sharing: Mapping[str, Any]) -> Figure:
    """Learning curves of the robots alone, as they share, and of one that sees everything, a panel a selector."""
    ways = list(next(iter(sharing["selectors"].values()))["ways"])
    colours = {"none": "muted", "all": "ink"}
    look = Look({way: colours.get(way, "c1") for way in ways}, {"all"})
    panels: list[Panel] = []
    at = np.array(sharing["at"])
    shown = list(sharing["selectors"].items())[:_MOST_PANELS]
    for name, entry in shown:
        lines = []
        for way, found in entry["ways"].items():
            mean, spread = np.array(found["curve"]), None if found["spread"] is None else np.array(found["spread"])
            lines.append(Line(way, mean) if spread is None else Line(way, mean, mean - spread, mean + spread))
        panels.append(curves(name, at, lines, look, ("decision of each robot", "mean reward so far"), settled_domain(at, lines)))
    caption = f"Mean reward of {sharing['robots']} robots up to each decision of theirs. {about(sharing)}"
    if len(shown) < len(sharing["selectors"]):
        caption += f" The first {len(shown)} of {len(sharing['selectors'])} selectors; the table has all."
    return Figure(
        "sharing", title(sharing).rpartition(":")[0], caption, f"Curves of the mean reward, a panel a selector. {conclusion(sharing)}", panels
    )


def sharing_table(sharing: Mapping[str, Any]) -> Table:
    """What each of that comes to, and how much of the gap sharing closes."""
    ways = list(next(iter(sharing["selectors"].values()))["ways"])
    rows: list[dict[str, Cell]] = [
        {
            "selector": name,
            **{way: _estimate(entry["ways"][way]["mean_reward"], entry["ways"][way]["ci95"]) for way in ways},
            "gap": _estimate(entry["gain"], entry["gain_ci95"]),
            "closed": _estimate(entry["gap_closed"], entry["gap_closed_ci95"]),
            "bytes": round(entry["message_bytes"]),
        }
        for name, entry in sharing["selectors"].items()
    ]
    columns = [
        Column("selector", "selector", "text"),
        *(Column(way, f"reward, {way}", digits=3) for way in ways),
        Column("gap", "all over none", digits=3),
        Column("closed", "closed by sharing", "percent"),
        Column("bytes", "bytes a message", digits=0),
    ]
    return Table("sharing", "What sharing is worth", conclusion(sharing), columns, rows)


def _estimate(value: float | None, ends: "list[float] | None") -> Cell:
    return value if value is None or ends is None else Estimate(value, ends[0], ends[1])
