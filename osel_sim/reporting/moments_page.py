"""The page of a replay of moments: whether to hand over, what is to be gained when, who drove, and duty against success."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from osel_sim.analysis.estimate import Estimate
from osel_sim.formats.moments_result import read_moments_result
from osel_sim.reporting.charts import Figure, Look, Panel, listed
from osel_sim.reporting.curves import Line, curves
from osel_sim.reporting.dots import Dot, certain, scatter
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Block, Page, Section, Tile, Verdict
from osel_sim.reporting.palette import colours
from osel_sim.reporting.who_drove import Drive, parts_of, who_drove

_TONES: dict[str, Literal["good", "neutral", "bad"]] = {"hand_over": "good", "do_not": "neutral", "unknown": "neutral"}
FEWEST = 3
"""Instances that a point of these curves needs."""
MOST_TASKS = 12
"""Panels of the curves of gains; `gains.csv` has all."""


def moments_page(folder: Path) -> Page:
    """The page of the replay of moments in a folder.

    Raises:
        DataError: there is none, or it is damaged.
    """
    result = read_moments_result(folder)
    verdict = result["verdict"]
    sections = [
        Section("arms", "Start selectors and monitors", [_arms(result), *_equal_duty(result)]),
        Section("gains", "What is to be gained, and when", [*_gains(result), _gain_table(result)]),
        Section("duty", "Duty against success", [_duty(result)]),
    ]
    if result["oracles"]:
        sections.append(Section("oracles", "Oracles", [_oracles(result["oracles"])]))
    said = Verdict(verdict["headline"], verdict["sentences"], _tiles(result), _TONES[verdict["decision"]])
    title = f"When to hand over: {', '.join(result['policies'])}"
    return Page("Handoffs", title, said, sections, _facts(result, folder), routes=_timeline(result))


def _best(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    verdict = result["verdict"]
    return next((arm for arm in result["arms"] if (arm["start"], arm["monitor"]) == (verdict["start"], verdict["monitor"])), None)


def _tiles(result: Mapping[str, Any]) -> list[Tile]:
    best = _best(result)
    if best is None or not best.get("gain"):
        return []
    gain, low, high = best["gain"]
    tiles = [Tile("reward an episode", f"{gain:+.3f}".replace("-", "\u2212"), f"between {low:+.3f} and {high:+.3f}".replace("-", "\u2212"))]
    if best["recovered"] is not None:
        tiles.append(Tile("recovered", f"{100 * best['recovered']:.0f}%", "of what the first policy alone would lose"))
    if best["harmed"] is not None:
        tiles.append(Tile("harmed", f"{100 * best['harmed']:.0f}%", "of what it would win"))
    return [*tiles, Tile("duty", f"{100 * best['duty']:.0f}%", "of the control steps are remote policies'")]


def _timeline(result: Mapping[str, Any]) -> Figure:
    """Who drove when, in some episodes."""
    verdict, episodes = result["verdict"], result["timeline"]
    drives = []
    for one in episodes:
        ends = ["solved" if one[name] else "not solved" for name in ("success", "success_alone")]
        about = f"{one['instance']}: {ends[0]}; {one['first']} alone: {ends[1]}"
        handoffs = [(one["at"], one["second"])] if one["second"] else []
        drives.append(Drive(one["task"], about, one["success"], parts_of(one["first"], handoffs, one["steps"])))
    handed = [one for one in episodes if one["second"]]
    saved, spoilt = (sum(one["success"] != one["success_alone"] and one["success"] == won for one in handed) for won in (True, False))
    caption = (
        f"{verdict['start']} at the start, {verdict['monitor'] or 'nobody'} as the monitor: {len(episodes)} episodes, a row each, by task. "
        f"{len(handed)} were handed over: {saved} of them were solved that the first policy alone would have lost, "
        f"{spoilt} lost that it would have solved."
    )
    return who_drove(drives, result["policies"], caption)


def _gains(result: Mapping[str, Any]) -> list[Block]:
    """A panel for all tasks together and each task: gain over the moment of handing over, a line for each pair."""
    gains = [gain for gain in result["gains"] if gain["moments"] >= FEWEST]
    tasks = list(dict.fromkeys(gain["task"] for gain in gains))
    pairs = list(dict.fromkeys(f"{gain['first']} to {gain['second']}" for gain in gains))
    if len(result["calls"]) < 2 or not gains:
        return []
    look, panels = Look(colours(pairs)), list[Panel]()
    for task in tasks[:MOST_TASKS]:
        lines = [
            _line(pair, [gain for gain in gains if gain["task"] == task and f"{gain['first']} to {gain['second']}" == pair], result) for pair in pairs
        ]
        panels.append(curves(task, result["calls"], lines, look, ("calls before the handover", "gain in reward")))
    best = max(gains, key=lambda gain: float(gain["gain"]["value"]) if gain["task"] != "all" else -9.0)
    return [
        Figure(
            "gains",
            "What handing over gains, from the same state",
            "Reward of handing over before that call minus the reward of going on, in episodes that were not over by then, with 95% intervals over "
            "instances. Of a blind handover: a monitor that sees which of them to hand over gains more. Later moments are of fewer and harder ones.",
            f"Most on {best['task']}: {best['first']} to {best['second']} before call {best['call']}, {best['gain']['value']:+.2f}.",
            panels,
        )
    ]


def _line(pair: str, own: Sequence[Mapping[str, Any]], result: Mapping[str, Any]) -> Line:
    at = {gain["call"]: gain["gain"] for gain in own}
    y, low, high = (np.array([at[call][end] if call in at else np.nan for call in result["calls"]], np.float64) for end in ("value", "low", "high"))
    return Line(pair, y, low, high)


def _gain_table(result: Mapping[str, Any]) -> Table:
    columns = [Column(name, name, "text") for name in ("task", "first", "second")]
    columns += [Column("call", "before call", digits=0), Column("moments", "instances", digits=0), Column("gain", "gain in reward", digits=3)]
    columns += [Column("recovered", "recovered", "percent"), Column("harmed", "harmed", "percent")]
    rows: list[dict[str, Cell]] = [{**gain, "gain": Estimate(**gain["gain"])} for gain in result["gains"]]
    caption = "Recovered: of the moments from which the first policy would lose, those from which the second wins; harmed: the other way round."
    return Table("gains", "Every task, pair and moment", caption, columns, rows)


def _arms(result: Mapping[str, Any]) -> Table:
    columns = [Column("start", "at the start", "text"), Column("monitor", "monitor", "text"), Column("reward", "mean reward", digits=3)]
    columns += [
        Column("gain", "gain by the monitor", digits=3),
        Column("p_reward_holm", "p (Holm)", digits=3),
        Column("success", "success", "percent"),
    ]
    columns += [
        Column("p_holm", "p of success (Holm)", digits=3),
        Column("price", "cents"),
        Column("seconds", "seconds"),
        Column("duty", "duty", "percent"),
    ]
    columns += [
        Column("recovered", "recovered", "percent"),
        Column("harmed", "harmed", "percent"),
        Column("of_gap", "of the gap to the oracle", "percent"),
    ]
    rows: list[dict[str, Cell]] = []
    for arm in sorted(result["arms"], key=lambda arm: -float(arm["reward"][0])):
        row: dict[str, Cell] = {name: _estimate(arm.get(name)) for name in ("reward", "gain", "success", "price", "seconds")}
        row |= {name: arm.get(name) for name in ("start", "monitor", "p_reward_holm", "p_holm", "duty", "recovered", "harmed", "of_gap")}
        rows.append(row)
    caption = (
        "Tests are paired over instances and exact (sign flips, McNemar's where nothing was repeated), corrected for the number of monitors. The gap "
        "is the one from the best single policy to the oracle of when."
    )
    return Table("arms", "Who is chosen, and who drives on", caption, columns, rows)


def _equal_duty(result: Mapping[str, Any]) -> list[Block]:
    columns = [Column("start", "at the start", "text"), Column("monitor", "monitor", "text"), Column("arm", "without looking", "text")]
    columns += [
        Column("duty", "duty", "percent"),
        Column("ahead", "monitor ahead by", digits=3),
        Column("recovered_by", "monitor recovers", "percent"),
    ]
    columns += [
        Column("recovered", "this recovers", "percent"),
        Column("harmed_by", "monitor harms", "percent"),
        Column("harmed", "this harms", "percent"),
    ]
    rows: list[dict[str, Cell]] = [
        {"start": arm["start"], "monitor": arm["monitor"], "arm": other["name"], "duty": other["duty"], "ahead": _estimate(other["ahead"])}
        | {"recovered_by": arm["recovered"], "recovered": other["recovered"], "harmed_by": arm["harmed"], "harmed": other["harmed"]}
        for arm in result["arms"]
        for other in arm.get("equal_duty", ())
    ]
    caption = "Blind handovers before a fixed call, two of them mixed where none has that duty, and random ones, from the same starts."
    return [Table("equal_duty", "Switching as much without looking", caption, columns, rows)] if rows else []


def _duty(result: Mapping[str, Any]) -> Figure:
    starts = list(dict.fromkeys(arm["start"] for arm in result["arms"]))
    arms = [arm for arm in result["arms"] if arm["monitor"] == "never" or arm["gain"] != [0.0, 0.0, 0.0]]
    dots = [Dot(arm["start"], certain(100 * arm["duty"]), _percent(arm["success"]), arm["monitor"]) for arm in arms]
    told = [f"{arm['start']} with {arm['monitor']} {100 * arm['success'][0]:.0f}% at {100 * arm['duty']:.0f}%" for arm in arms]
    caption = (
        "Each dot is a start selector with a monitor that hands something over, or with none. Up and to the left is better: more success with fewer "
        "steps of remote policies."
    )
    return Figure(
        "duty",
        "Duty against success",
        caption,
        f"Success by duty: {listed(told)}.",
        [scatter("", dots, Look(colours(starts)), ("duty (%)", "success (%)"))],
    )


def _oracles(found: Mapping[str, Any]) -> Table:
    columns = [Column("oracle", "oracle", "text"), Column("reward", "mean reward", digits=3), Column("about", "how it chooses", "text")]
    rows: list[dict[str, Cell]] = [
        {"oracle": f"always {found['single']}", "reward": found["single_reward"], "about": "the best single policy, to the end"},
        {"oracle": "of choosing once", "reward": _estimate(found["once"]), "about": "the best policy of each instance by its other repeats"},
        {
            "oracle": "of when",
            "reward": _estimate(found["when"]),
            "about": "the best first policy, moment and second policy by its other repeats",
        },
        {"oracle": "of choosing once, in hindsight", "reward": found["hindsight_once"], "about": "counts luck as foresight"},
        {"oracle": "of when, in hindsight", "reward": found["hindsight_when"], "about": "counts luck as foresight"},
    ]
    most = ", ".join(f"{name} ({count})" for name, count in list(found["chosen"].items())[:6])
    caption = f"On the {found['instances']} instances with repeats. The oracle of when takes most often: {most}."
    return Table("oracles", "What could be known at most", caption, columns, rows)


def _facts(result: Mapping[str, Any], folder: Path) -> list[tuple[str, str]]:
    log = result["log"]
    facts = [("replay", str(folder)), ("log", log["folder"]), ("encoder", log["encoder"]), ("half", log["half"])]
    facts += [("instances", f"{result['instances']}, learned from {result['learned_from']} others"), ("moments", f"{log['moments']:,}")]
    facts += [("decision points", f"before calls {', '.join(map(str, result['calls']))}")]
    return [*facts, ("reward", ", ".join(f"{name} {value}" for name, value in result["reward"].items()))]


def _estimate(found: Sequence[float] | None) -> Estimate | None:
    return None if found is None else Estimate(*found)


def _percent(found: Sequence[float]) -> Estimate:
    return Estimate(*(100.0 * value for value in found))
