"""Sections about budgets: what a live run spent of its own, and what a replay came to within several."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.formats.budget import read_budget
from osel_sim.formats.journal import Decision
from osel_sim.reporting.charts import Figure, Look
from osel_sim.reporting.curves import Line, curves, thinned
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Block, Section

ORACLES = {
    "hindsight": "hindsight oracle with the same budget",
    "expected": "expected oracle with the same budget",
    "mix": "best mix of policies, without context",
}


def run_budget(folder: Path, decisions: Sequence[Decision]) -> list[Section]:
    """What a run spent against its budget, and what a cent was worth; nothing where it had none, or has not ended yet."""
    found = read_budget(folder)
    if found is None or not decisions:
        return []
    prices = np.array([decision.price for decision in decisions])
    period = np.arange(len(prices)) // found.period
    spent = np.concatenate([prices[period == one].cumsum() for one in range(int(period[-1]) + 1)])
    even = found.cents * (np.arange(len(prices)) % found.period + 1) / found.period
    at = thinned(len(prices))
    look = Look({"spent": "c0", "spent evenly": "muted", "budget": "bad"}, {"spent evenly", "budget"})
    lines = [Line("spent", spent[at]), Line("spent evenly", even[at]), Line("budget", np.full(len(at), found.cents))]
    panels = [curves("Cents spent", at + 1, lines, look, ("decision", "cents"), steps=True)]
    if len(found.prices) >= len(prices):
        worth = 100.0 * np.array(found.prices)[: len(prices)]
        panels.append(curves("What a dollar was worth", at + 1, [Line("spent", worth[at])], look.only({"spent"}), ("decision", "reward a dollar")))
    each = f" A new budget begins every {found.period} decisions." if len(prices) > found.period else ""
    caption = (
        "Cents spent so far against the budget, and what one more dollar would have bought at each decision: policies were chosen as if every cent "
        f"cost so much reward. 0: the budget did not bind.{each}"
    )
    text = f"Curve of cents spent: {found.spent:.2f} in the end, of {found.cents:g} for {found.period} decisions. {found.sentence}."
    words = [f"The run {found.sentence}.", *([f"It ended there: {found.ended}."] if found.ended else [])]
    return [Section("budget", "Budget", [" ".join(words), Figure("budget", "Spending", caption, text, panels)])]


def replay_budget(found: Mapping[str, Any] | None) -> list[Section]:
    """Reward at several budgets against the best that could be had with as much; nothing where none was replayed.

    Args:
        found: `budget` of `replay.json`.
    """
    if not found:
        return []
    cents = np.array(found["cents"])
    own = {name: np.array([entry["reward"] for entry in entries]) for name, entries in found["selectors"].items()}
    bounds = {ORACLES[name]: np.array(values, np.float64) for name, values in found["oracles"].items() if None not in values}
    look = Look({**{name: f"c{index}" for index, name in enumerate(own)}, **dict(zip(bounds, ("ink", "c7", "muted"), strict=False))}, set(bounds))
    lines = [*_with_errors(found, own), *(Line(name, values) for name, values in bounds.items())]
    over = f"for each {found['period']} decisions" if found["period"] != found["decisions"] else f"for {found['decisions']:,} decisions"
    caption = (
        f"Mean reward a decision within budgets {over}, over {found['seeds']} orders; bands are two standard errors. The oracles solve the "
        "knapsack with all outcomes at hand: hindsight chooses and scores on the same outcomes, expected on different repeats. The mix knows what "
        "policies come to on average and nothing of the instance."
    )
    best = max(own, key=lambda name: float(own[name].mean())) if own else ""
    told = [f"{budget:g} cents {value:.3f}" for budget, value in zip(cents, own[best], strict=True)] if best else []
    text = f"Curves of mean reward over the budget in cents. {best}: {', '.join(told)}."
    panel = curves("", cents, lines, look, (f"budget in cents, {over}", "mean reward"))
    blocks: list[Block] = [Figure("budget", "Reward at several budgets", caption, text, [panel]), budget_table(found)]
    return [Section("budget", "Budget", blocks)]


def budget_table(found: Mapping[str, Any]) -> Table:
    """Each selector at each budget."""
    rows: list[dict[str, Cell]] = []
    for name, entries in found["selectors"].items():
        for at, (cents, entry) in enumerate(zip(found["cents"], entries, strict=True)):
            bounds = {key: values[at] for key, values in found["oracles"].items()}
            row: dict[str, Cell] = {"selector": name, "cents": cents, "asked": "yes" if cents == found["asked"] else ""}
            row |= {key: entry[key] for key in ("reward", "success", "spent", "most_spent", "made")}
            rows.append({**row, **bounds, "dollar": dollar(entries, found, at)})
    columns = [
        *(Column("selector", "selector", "text"), Column("cents", "budget (cents)", digits=None), Column("asked", "asked for", "text")),
        *(Column("reward", "mean reward", digits=3), Column("success", "success", "percent")),
        *(
            Column("spent", "spent (cents)", digits=None),
            Column("most_spent", "most in any order", digits=None),
            Column("made", "decided", "percent"),
        ),
        *(Column(name, name, digits=3) for name in ("hindsight", "expected", "mix")),
        Column("dollar", "reward of one more dollar", digits=2),
    ]
    caption = (
        "What was spent never exceeds the budget of a period. Decided: in which share of the decisions some policy could be paid; the others earn "
        "nothing. One more dollar: the slope of the selector's own curve up to the next budget, over a period's decisions."
    )
    return Table("budget", "Within budgets", caption, columns, rows)


def dollar(entries: Sequence[Mapping[str, float]], found: Mapping[str, Any], at: int) -> float | None:
    """Reward of one more dollar in a period: the slope to the next budget; None at the last."""
    if at + 1 == len(entries):
        return None
    gain = (entries[at + 1]["reward"] - entries[at]["reward"]) * found["period"]
    return 100.0 * float(gain) / float(found["cents"][at + 1] - found["cents"][at])


def _with_errors(found: Mapping[str, Any], own: Mapping[str, Any]) -> list[Line]:
    errors = {name: 2.0 * np.array([entry["error"] for entry in entries]) for name, entries in found["selectors"].items()}
    return [Line(name, values, values - errors[name], values + errors[name]) for name, values in own.items()]
