"""The page of a replay whose streams change: who joins, who leaves, and how soon selectors follow."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.analysis.estimate import Estimate
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.formats.replay_result import CHANGES
from osel_sim.reporting.charts import Figure, Look, listed
from osel_sim.reporting.curves import Line, curves
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.log_page import few, log_facts, log_sections
from osel_sim.reporting.page import Block, Page, Section, Tile, Verdict
from osel_sim.selection.reward import RewardWeights

WAYS = {"through": "through the changes", "afresh": "begun afresh at the change", "knew": "one that knew"}
LOOK = Look({"through the changes": "c0", "begun afresh at the change": "c1", "one that knew": "c8"}, dashed=("one that knew",))
_MOST = 4
"""Selectors of which curves are drawn."""


def changing_page(folder: Path, result: Mapping[str, Any], log: LoggedOutcomes, weights: RewardWeights) -> Page:
    """The page.

    Args:
        log: the replayed instances, as they are where nothing changes.
    """
    found = result[CHANGES]
    blocks: list[Block] = [reward_figure(result)]
    share = share_figure(result)
    blocks += [] if share is None else [share]
    blocks += [*(_span_table(found, index) for index in range(len(found["spans"]) - 1))]
    blocks += [_newcomers(found)] if any(entry["newcomers"] for entry in found["selectors"].values()) else []
    blocks.append(_there(found))
    shared, _ = log_sections(log, weights)
    title = f"{few(result['log']['tasks'])}: {len(found['selectors'])} selectors over {result['decisions']:,} decisions that change"
    facts = [("replay", str(folder)), *((f"change {number}", event["words"]) for number, event in enumerate(found["events"], 1))]
    facts += [("seeds", str(len(result["seeds"]))), ("decisions a seed", f"{result['decisions']:,}"), ("preset", str(result["reward"].get("preset")))]
    words = result["verdict"]
    verdict = Verdict(words["headline"], words["sentences"], _tiles(result))
    sections = [Section("changes", "What changed", blocks), *shared]
    return Page("Replay of changing streams", title, verdict, sections, [*facts, *log_facts(log, weights)])


def reward_figure(result: Mapping[str, Any]) -> Figure:
    """Mean reward lately of the selectors that received most, three ways each."""
    found, names = result[CHANGES], _shown(result)
    panels = []
    for name in names:
        own = found["curves"][name]
        lines = [Line(shown, _values(own["reward"][way])) for way, shown in WAYS.items()]
        panels.append(curves(name, np.array(own["decision"]) + 1, lines, LOOK, ("decision", f"reward, last {found['lately']} decisions")))
    caption = (
        f"Mean reward of the last {found['lately']} decisions (since the change, where those are fewer), over all seeds. Changes: {_told(found)}. "
        "Begun afresh: the same selector, new at the change. One that knew: it had what is there after the change from the first decision."
    )
    ends = [f"{name} {entry['spans'][-1]['whole']['mean_reward']:.3f}" for name, entry in found["selectors"].items() if entry["spans"]]
    return Figure("changing_reward", "Reward while things change", caption, f"Curves. After the last change: {listed(ends)}.", panels)


def share_figure(result: Mapping[str, Any]) -> Figure | None:
    """How often a policy that joined is chosen, of the selectors that received most; None where none joins."""
    found, panels = result[CHANGES], []
    newcomers = dict.fromkeys(event["policy"] for event in found["events"] if event["kind"] == "join")
    for name in _shown(result):
        own = found["curves"][name]
        for policy in newcomers:
            lines = [Line(shown, 100.0 * _values(own["share"][policy][way])) for way, shown in WAYS.items()]
            axes = ("decision", "chosen (%)")
            panels.append(curves(f"{name}: {policy}", np.array(own["decision"]) + 1, lines, LOOK, axes, (-2.0, 102.0)))
    if not panels:
        return None
    caption = f"Share of the last {found['lately']} decisions, over all seeds, in which the policy that joined is chosen."
    ends = [f"{name} {_arrived(entry['newcomers'])}" for name, entry in found["selectors"].items()]
    return Figure("changing_share", "How soon a newcomer is chosen", caption, f"Curves. Decisions until the fair share: {listed(ends)}.", panels)


def _arrived(newcomers: Sequence[Mapping[str, Any]]) -> str:
    after = [(newcomer["policy"], newcomer["decisions"]["through"]) for newcomer in newcomers]
    return ", ".join(f"{policy} {'never' if decisions is None else decisions}" for policy, decisions in after)


def _shown(result: Mapping[str, Any]) -> list[str]:
    """The selector that the verdict is about, and those that received most."""
    entries, first = result["selectors"], result["verdict"]["selector"]
    names = sorted(entries, key=lambda name: (name != first, -float(entries[name]["mean_reward"])))
    return names[:_MOST]


def _values(values: Sequence[float | None]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _told(found: Mapping[str, Any]) -> str:
    return ", ".join(event["words"] for event in found["events"])


def _tiles(result: Mapping[str, Any]) -> list[Tile]:
    name = result["verdict"]["selector"]
    if name is None:
        return []
    own, entry = result["selectors"][name], result[CHANGES]["selectors"][name]
    tiles = [Tile("selector", name, f"mean reward {own['mean_reward']:.3f} over the whole stream")]
    for newcomer in entry["newcomers"]:
        after = newcomer["decisions"]["through"]
        note = f"its fair share is {100 * newcomer['fair_share']:.0f}% of the decisions"
        tiles.append(Tile(f"{newcomer['policy']} has its share after", "not in these" if after is None else f"{after} decisions", note))
    return tiles


def _estimate(entry: Mapping[str, Any]) -> Cell:
    low, high = entry["ci95"] or (float("-inf"), float("inf"))
    return Estimate(entry["mean"], low, high)


def _span_table(found: Mapping[str, Any], index: int) -> Table:
    span = found["spans"][index + 1]
    rows: list[dict[str, Cell]] = []
    for name, entry in found["selectors"].items():
        own = entry["spans"][index]
        soon, through = own["soon"], own["ways"]["through"]
        row: dict[str, Cell] = {"selector": name, "reward": soon["mean_reward"]}
        row |= {way: soon[f"mean_reward_{way}"] for way in ("knew", "afresh")}
        row |= {"against_knew": _estimate(soon["against_knew"]), "against_afresh": _estimate(soon["against_afresh"])}
        row |= {"lost": -own["whole"]["against_knew"]["sum"], "regret": -soon["against_oracle"]["mean"]}
        rows.append(row | {"success": through["success_rate"], "price": through["mean_price"]})
    columns = [
        *(Column("selector", "selector", "text"), Column("reward", "reward soon after", digits=3), Column("knew", "one that knew", digits=3)),
        *(Column("afresh", "begun afresh", digits=3), Column("against_knew", "against one that knew", digits=3)),
        *(Column("against_afresh", "against begun afresh", digits=3), Column("lost", "lost to one that knew, in all", digits=1)),
        *(Column("regret", "regret to the oracle", digits=3), Column("success", "success", "percent"), Column("price", "cents", digits=None)),
    ]
    best, there = span["best_single"], ", ".join(span["policies"])
    caption = (
        f"Decisions {span['from']:,} to {span['to'] - 1:,}, with {there}. Soon after: the first {found['window']} of them at most, reward a "
        f"decision, with 95% intervals over instances. Lost in all: a stream, up to the next change. The best single policy is {best['policy']} "
        f"({best['mean_reward']:.3f}); the oracle, a router trained on the outcomes of other instances as they are after the change, receives "
        f"{span['oracle']:.3f}. Success and cents are those of all these decisions."
    )
    return Table(f"change_{index + 1}", f"After {' and '.join(span['changes'])}", caption, columns, rows)


def _newcomers(found: Mapping[str, Any]) -> Table:
    rows: list[dict[str, Cell]] = [
        {
            **{"selector": name, "policy": newcomer["policy"], "at": newcomer["at"], "fair_share": newcomer["fair_share"]},
            **{way: newcomer["decisions"][way] for way in WAYS},
        }
        for name, entry in found["selectors"].items()
        for newcomer in entry["newcomers"]
    ]
    columns = [
        *(Column("selector", "selector", "text"), Column("policy", "newcomer", "text"), Column("at", "joins at", digits=0)),
        *(Column("fair_share", "fair share", "percent"), Column("through", "decisions until it has it", digits=0)),
        *(Column("afresh", "of one begun afresh", digits=0), Column("knew", "of one that knew", digits=0)),
    ]
    caption = (
        f"The fair share is {found['fair']:g} of what the newcomer has in the last quarter, up to the next change, under the selector that knew. "
        f"It has it once {found['lately']} decisions in a row, over all seeds, give it that much; counted are the decisions before these. A dash "
        "where that does not happen."
    )
    return Table("newcomers", "Decisions until a newcomer has its fair share", caption, columns, rows)


def _there(found: Mapping[str, Any]) -> Table:
    """What each policy alone would receive in each span; nothing where it is not there."""
    policies = list(dict.fromkeys(policy for span in found["spans"] for policy in span["policies"]))
    rows: list[dict[str, Cell]] = [
        {"from": span["from"], "changes": " and ".join(span["changes"]) or "the beginning"}
        | {f"p{number}": span["always"].get(policy) for number, policy in enumerate(policies)}
        | {"oracle": span["oracle"]}
        for span in found["spans"]
    ]
    columns = [Column("from", "from decision", digits=0), Column("changes", "with", "text")]
    columns += [*(Column(f"p{number}", f"always {policy}", digits=3) for number, policy in enumerate(policies)), Column("oracle", "oracle", digits=3)]
    caption = "Mean reward between two changes of always one policy, and of the oracle among those that are there. A dash: the policy is not there."
    return Table("there", "What there is to choose from", caption, columns, rows)
