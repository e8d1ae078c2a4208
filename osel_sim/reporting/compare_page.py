"""The page of a comparison: is it worse, by how much, on which tasks, and which instances changed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import altair as alt

from osel_sim.analysis.estimate import Estimate
from osel_sim.formats.compare_result import read_compare
from osel_sim.reporting.charts import Figure, Look, Panel, listed
from osel_sim.reporting.comparison import SHARES, losses_first, notes, probability
from osel_sim.reporting.dots import rows
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Block, Page, Section, Tile, Verdict
from osel_sim.reporting.palette import LIGHT, colours

MOST_FLIPS = 500
"""Rows of the table of instances that changed; `compare.json` has all."""
HEADLINES = {
    "better": "Better",
    "no worse": "No worse",
    "worse": "Worse",
    "not enough data": "Not enough data to tell",
}
_TONES: dict[str, Literal["good", "neutral", "bad"]] = {"better": "good", "no worse": "good", "worse": "bad", "not enough data": "neutral"}
_HEADINGS = {"price": "price (cents)"}


def compare_page(folder: Path) -> Page:
    """The page of the comparison in a folder.

    Raises:
        DataError: there is none, or it is damaged.
    """
    return page_of(read_compare(folder), folder)


def page_of(result: Mapping[str, Any], folder: Path) -> Page:
    """The page of a comparison, as `compare.json` has it; `folder`: where that lies."""
    names = [policy["name"] for policy in result["policies"]]
    entries = [entry for entry in result["pairs"] if entry["first"] == names[0]]
    look = Look(colours(names))
    said = list(dict.fromkeys(note for entry in entries for note in notes(entry)))
    sections = [Section("differences", "Differences", [*said, _difference_table(entries), _mean_table(entries)])]
    if tasks := _tasks(entries, look, 100 * result["margin"]):
        sections.append(Section("tasks", "Task by task", tasks))
    if len(names) > 2:
        sections.append(Section("pairs", "All pairs", [_pairs(result), _letters(result)]))
    if flips := _flips(entries):
        sections.append(Section("flips", "What changed, instance by instance", [flips]))
    others = f"{names[1]}" if len(names) == 2 else f"{len(names) - 1} others"
    title = f"{others} compared with {names[0]}, on the same instances"
    return Page("Comparison", title, _verdict(result, entries), sections, _facts(result, folder), routes=_success(result, entries, look))


def _verdict(result: Mapping[str, Any], entries: Sequence[Mapping[str, Any]]) -> Verdict:
    decision = result["verdict"]["decision"]
    told = [entry["second"] for entry in entries if entry["verdict"]["decision"] == decision]
    headline = HEADLINES[decision] if len(entries) == 1 else f"{HEADLINES[decision]}: {listed(told, 3)}"
    tiles = [_tile(entry) for entry in entries[:4]]
    return Verdict(headline, [entry["verdict"]["text"] for entry in entries], tiles, _TONES[decision])


def _tile(entry: Mapping[str, Any]) -> Tile:
    found, verdict = entry["differences"]["success"], entry["verdict"]
    ends = f"between {100 * verdict['low']:+.1f} and {100 * verdict['high']:+.1f}, on {entry['instances']:,} instances"
    return Tile(f"{entry['second']}: points of success", _signed(100 * found["difference"], 1), ends.replace("-", "\u2212"))


def _success(result: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], look: Look) -> Figure:
    """What stands below the verdict."""
    first, margin = entries[0]["first"], 100 * result["margin"]
    found = {entry["second"]: {entry["second"]: _points(entry["differences"]["success"])} for entry in entries}
    return Figure(
        "success",
        f"Success compared with {first}",
        f"Difference of success from {first}, in points, with 95% intervals of pairs. Left of the dashed line it is worse by more than the margin of "
        f"{margin:g} points.",
        "Difference of success in points: " + listed([f"{name} {_words(own[name])}" for name, own in found.items()]) + ".",
        [_with_margin(rows("difference of success (points)", list(found), found, look.only(found), "difference of success (points)"), margin)],
    )


def _difference_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    measures = _measures(entries)
    columns = [Column("second", "policy", "text"), Column("instances", "instances", digits=0)]
    columns += [Column(name, f"{name} (points)" if name in SHARES else _HEADINGS.get(name, name), digits=None) for name in measures]
    cells: list[dict[str, Cell]] = [
        {"second": entry["second"], "instances": entry["instances"]}
        | {name: _estimate(entry["differences"].get(name), 100.0 if name in SHARES else 1.0) for name in measures}
        for entry in entries
    ]
    caption = "The policy's mean minus the first's, on the instances of both; an interval is one of paired differences."
    return Table("differences", f"Differences from {entries[0]['first']}", caption, columns, cells)


def _mean_table(entries: Sequence[Mapping[str, Any]]) -> Table:
    measures = _measures(entries)
    columns = [Column("compared", "compared", "text"), Column("policy", "policy", "text")]
    columns += [
        Column(name, _HEADINGS.get(name, name), "percent" if name in SHARES else "number", None if name not in SHARES else 0) for name in measures
    ]
    cells: list[dict[str, Cell]] = [
        {"compared": f"{entry['second']} with {entry['first']}", "policy": entry[side]}
        | {name: entry["differences"][name][side] if name in entry["differences"] else None for name in measures}
        for entry in entries
        for side in ("first", "second")
    ]
    return Table("means", "Means", "Of both, on the instances that both have; an instance's value is its mean over repeats.", columns, cells)


def _tasks(entries: Sequence[Mapping[str, Any]], look: Look, margin: float) -> list[Block]:
    tasks = sorted({task for entry in entries for task in entry["tasks"]})
    if not tasks:
        return []
    found = {entry["second"]: {task: _points(part) for task, part in entry["tasks"].items()} for entry in entries}
    told = [f"{entry['second']} on {task}: {part['decision']}" for entry in entries for task, part in entry["tasks"].items() if part["decision"]]
    figure = Figure(
        "tasks",
        "Success by task",
        "Difference of success on each task, in points, with 95% intervals, which are not corrected for their number; the table's p are.",
        f"Told apart: {listed(told) if told else 'none'}.",
        [_with_margin(rows("difference of success (points)", tasks, found, look.only(found), "difference of success (points)"), margin)],
    )
    columns = [Column("second", "policy", "text"), Column("task", "task", "text"), Column("instances", "instances", digits=0)]
    columns += [Column("before", f"{entries[0]['first']}", "percent"), Column("after", "policy's own", "percent")]
    columns += [Column("difference", "difference (points)", digits=1), Column("p", "p (Holm)", "text"), Column("decision", "it is", "text")]
    cells: list[dict[str, Cell]] = [
        {"second": entry["second"], "task": task, "instances": part["instances"], "before": part["first"], "after": part["second"]}
        | {"difference": _points(part), "p": probability(part["p_holm"]), "decision": part["decision"] or "not told apart"}
        for entry in entries
        for task, part in entry["tasks"].items()
    ]
    return [figure, Table("tasks", "Task by task", "p with Holm's correction over the tasks.", columns, cells)]


def _pairs(result: Mapping[str, Any]) -> Table:
    columns = [Column("first", "first", "text"), Column("second", "second", "text"), Column("instances", "instances", digits=0)]
    columns += [Column("difference", "difference of success (points)", digits=1), Column("p", "p", "text"), Column("p_holm", "p (Holm)", "text")]
    columns += [Column("decision", "second is", "text")]
    cells: list[dict[str, Cell]] = [
        {"first": entry["first"], "second": entry["second"], "instances": entry["instances"], "difference": _points(entry["differences"]["success"])}
        | {"p": probability(entry["test"]["p"]), "p_holm": probability(entry["test"]["p_holm"]), "decision": entry["verdict"]["decision"]}
        for entry in result["pairs"]
    ]
    return Table("pairs", "All pairs", "p with Holm's correction over all pairs.", columns, cells)


def _letters(result: Mapping[str, Any]) -> Table:
    cells: list[dict[str, Cell]] = [{"policy": name, "letters": letters} for name, letters in (result["letters"] or {}).items()]
    columns = [Column("policy", "policy", "text"), Column("letters", "letters", "text")]
    return Table("letters", "Who was told apart", "Policies that share a letter were not told apart; the best come first.", columns, cells)


def _flips(entries: Sequence[Mapping[str, Any]]) -> Table | None:
    columns = [Column("second", "policy", "text"), Column("instance", "instance", "text"), Column("task", "task", "text")]
    columns += [Column("before", entries[0]["first"], "percent"), Column("after", "policy's own", "percent")]
    cells: list[dict[str, Cell]] = [
        {"second": entry["second"], "instance": flip["instance"], "task": flip["task"], "before": flip["first"], "after": flip["second"]}
        for entry in entries
        for flip in losses_first(entry)
    ]
    if not cells:
        return None
    rest = f" The first {MOST_FLIPS} of {len(cells):,}; compare.json has all." if len(cells) > MOST_FLIPS else ""
    caption = f"Instances whose success is not the same, those lost before those gained.{rest}"
    return Table("flips", f"{len(cells):,} instances changed", caption, columns, cells[:MOST_FLIPS])


def _facts(result: Mapping[str, Any], folder: Path) -> list[tuple[str, str]]:
    facts = [("comparison", str(folder)), *((policy["name"], f"{policy['policy']} of {policy['log']}") for policy in result["policies"])]
    facts += [("margin", f"{100 * result['margin']:g} points"), ("error", f"{100 * result['error']:g}%, all pairs together")]
    return [*facts, ("reward", ", ".join(f"{name} {value}" for name, value in result["reward"].items()))]


def _with_margin(panel: Panel, margin: float) -> Panel:
    """Lines at no difference and at the margin, under the dots."""
    told = alt.Tooltip("what:N", title="title")

    def line(at: float, what: str, colour: str, dash: Sequence[int]) -> alt.Chart:
        base = alt.Chart(alt.InlineData(values=[{"at": at, "what": what}]))
        drawn: alt.Chart = base.mark_rule(color=LIGHT[colour], strokeDash=list(dash), strokeWidth=1.2).encode(x=alt.X("at:Q"), tooltip=told)
        return drawn

    lines = [line(0.0, "no difference", "muted", (1, 0))]
    lines += [line(-margin, f"worse by the margin of {margin:g} points", "bad", (5, 3))] if margin else []
    panel.layer[1:1] = lines
    return panel


def _measures(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for entry in entries for name in entry["differences"]))


def _estimate(found: Mapping[str, Any] | None, factor: float) -> Estimate | None:
    if found is None:
        return None
    low, high = found["ci95"] or (float("nan"), float("nan"))
    return Estimate(factor * found["difference"], factor * low, factor * high)


def _points(found: Mapping[str, Any]) -> Estimate:
    low, high = found["ci95"] or (float("nan"), float("nan"))
    return Estimate(100 * found["difference"], 100 * low, 100 * high)


def _words(estimate: Estimate) -> str:
    return f"{estimate.value:+.1f} [{estimate.low:+.1f}, {estimate.high:+.1f}]"


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "\u2212")
