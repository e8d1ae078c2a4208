"""Tables of a replay."""

from collections.abc import Mapping
from typing import Any

from osel_sim.analysis.estimate import Estimate
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.selector_sections import ORACLES

SINGLES = ("best_single", "worst_single")
"""Second names of the fixed policies with the highest and the lowest mean reward."""


def gaps(entry: Mapping[str, Any]) -> tuple[Estimate | float | None, Estimate | float | None]:
    """Share of the learnable gap a selector closed, over the whole stream and its last quarter."""
    return _estimate(entry, "learnable_gap_closed"), _estimate(entry, "learnable_gap_closed_late")


def _estimate(entry: Mapping[str, Any], key: str, interval: str | None = None) -> Estimate | float | None:
    value, ends = entry.get(key), entry.get(interval or f"{key}_ci95")
    if value is None or ends is None:
        return value
    return Estimate(float(value), float(ends[0]), float(ends[1]))


def selector_table(result: Mapping[str, Any], names: Mapping[str, str]) -> Table:
    """Every selector, the best first.

    Args:
        result: of `replay.json`.
        names: selector -> what it is called on the page.
    """
    rows: list[dict[str, Cell]] = []
    learnable = result["learnable_oracle"]["name"]
    predictable = learnable != "expected" or "predictable" not in result["oracles"]
    also = _measures(result["reward"])
    shown = sorted(names, key=lambda name: -float(result["selectors"][name]["mean_reward"]))
    for name in shown:
        entry = result["selectors"][name]
        learns = entry["kind"] == "learner"
        rows.append(
            {
                "selector": names[name],
                "reward": _estimate(entry, "mean_reward", "ci95"),
                "success": _estimate(entry, "success_rate", "success_ci95"),
                **{key: entry.get(key) for key in also},
                "gap": gaps(entry)[0] if learns else None,
                "gap_late": gaps(entry)[1] if learns else None,
                **({} if predictable else {"predictable_late": _estimate(entry, "predictable_gap_closed_late") if learns else None}),
                **{f"regret_{oracle}": _of(entry, "regret", oracle) for oracle in result["oracles"] if oracle in ORACLES},
                "ahead": entry["decisions_until_ahead"] if learns else None,
            }
        )
    columns = [
        *(Column("selector", "selector", "text"), Column("reward", "mean reward", digits=3), Column("success", "success", "percent")),
        *(Column(key, heading, digits=digits) for key, (heading, digits) in also.items()),
        *(Column("gap", "gap closed", "percent"), Column("gap_late", "last quarter", "percent")),
        *([] if predictable else [Column("predictable_late", "of the predictable", "percent")]),
        *(Column(f"regret_{oracle}", f"regret to {word}", digits=3) for oracle, word in ORACLES.items() if oracle in result["oracles"]),
        Column("ahead", "ahead after"),
    ]
    over = _over_what(result)
    caption = (
        f"The best first. {over} Gap and regret: also over what the expected oracle may be off. "
        "Regret: reward a decision below the oracle. Gap closed: share of the way "
        f"from the best single policy to the {ORACLES.get(learnable, 'learnable oracle')}{'' if predictable else ', also to the predictable one'}; "
        "a dash where there is no gap to close, or none that is more than its error. "
        "Ahead after: decisions until its rewards pass the best single policy's for good."
    )
    if any(name.endswith(":warm") for name in names):
        caption += " A selector named :warm was shown the outcomes of the log's other half before its first decision."
    return Table("selectors", "What each selector came to", caption, columns, rows)


def _measures(reward: Mapping[str, Any]) -> dict[str, tuple[str, int | None]]:
    """Which means a table of selectors shows besides reward and success, with their headings and digits: what the reward is made of."""
    graded = {"subgoals": {"mean_subgoals": ("subgoals", 2)}, "score": {"mean_score": ("score", 4)}}.get(reward["success"], {})
    time = {"mean_steps": ("steps", 0)} if reward["time_unit"].endswith("steps") else {"mean_seconds": ("seconds", 2)}
    return {**graded, **time, "mean_price": ("price (cents)", None)}


def oracle_table(result: Mapping[str, Any]) -> Table:
    """The oracles, and what each knows."""
    meaning = {
        "hindsight": "best outcome of each decision, known only afterwards: optimistic, not learnable where outcomes are noisy",
        "expected": "best policy of each instance by its mean over some repeats, scored on the others",
        "predictable": f"supervised router trained on all outcomes of one half of the instances, scored on the other half{_routers(result)}",
        "per_task": "best policy of each task",
        "best_single": "best policy over all instances",
    }
    rows: list[dict[str, Cell]] = [
        {
            "oracle": ORACLES.get(name, name.replace("_", " ")),
            "reward": _estimate(entry, "mean_reward", "ci95"),
            "gain": None if name == "best_single" else _estimate(entry, "gain", "gain_ci95"),
            "meaning": meaning.get(name, ""),
        }
        for name, entry in result["oracles"].items()
    ]
    columns = [
        *(Column("oracle", "oracle", "text"), Column("reward", "mean reward", digits=3), Column("gain", "over the best single policy", digits=3)),
        Column("meaning", "what it is", "text"),
    ]
    learnable, beaten = result["learnable_oracle"]["name"], result["learnable_oracle"].get("beaten", {})
    caption = f"The learnable gap is that between the best single policy and the {ORACLES[learnable]}." if learnable else ""
    caption += " Intervals of the gains are over instances: a gain whose interval reaches zero is no gap to close."
    caption += "".join(f" The {ORACLES[name]} is left out: {selector} earned more, so it bounds nothing here." for name, selector in beaten.items())
    if (repeated := result["learnable_oracle"].get("repeated")) and "expected" in result["oracles"]:
        caption += f" The expected one is an estimate, from the {repeated} of {result['log']['instances']} instances that have repeats."
    return Table("oracles", "What could have been", caption, columns, rows)


def _routers(result: Mapping[str, Any]) -> str:
    found = dict.fromkeys(result["learnable_oracle"].get("router", {}).values())
    return f" (here by {' and '.join(found)})" if found else ""


def paired_tables(result: Mapping[str, Any], names: Mapping[str, str]) -> list[Table]:
    """Differences of each selector to the best single policy and to the best selector."""
    learners = [name for name, entry in result["selectors"].items() if entry["kind"] == "learner"]
    if not learners or not result["paired"]:
        return []
    best = max(learners, key=lambda name: float(result["selectors"][name]["mean_reward"]))
    references = dict.fromkeys([SINGLES[0], best])
    rows: list[dict[str, Cell]] = []
    for reference in references:
        for entry in result["paired"]:
            if reference not in (entry["a"], entry["b"]):
                continue
            other, sign = (entry["a"], 1.0) if entry["b"] == reference else (entry["b"], -1.0)
            if other in references and reference != SINGLES[0]:
                continue
            rows.append(
                {
                    "selector": names.get(other, other),
                    "against": names.get(reference, reference.replace("_", " ")),
                    "difference": _signed(_estimate(entry, "difference", "ci95"), sign),
                    "late": _signed(_estimate(entry, "difference_late", "ci95_late"), sign),
                }
            )
    columns = [
        *(Column("selector", "selector", "text"), Column("against", "against", "text")),
        *(Column("difference", "difference in reward", digits=4), Column("late", "in the last quarter", digits=4)),
    ]
    caption = f"Differences on the same streams; paired.csv of the replay has all pairs. {_over_what(result)}"
    return [Table("paired_differences", "Paired differences", caption, columns, rows)]


def _over_what(result: Mapping[str, Any]) -> str:
    """What the intervals say."""
    if result["schema_version"] == 1:
        return "Means with 95% bootstrap intervals over seeds: what another order of the same instances would change, not what other instances would."
    return (
        "Means with 95% intervals over instances: what others of the kind would change, what is learned from them included. "
        "What another order of the same ones would change is in selectors.csv and paired.csv of the replay (orders_ci95)."
    )


def _signed(estimate: Estimate | float | None, sign: float) -> Estimate | float | None:
    if not isinstance(estimate, Estimate):
        return estimate and sign * estimate
    if sign > 0:
        return estimate
    return Estimate(-estimate.value, -estimate.high, -estimate.low)


def _of(entry: Mapping[str, Any], key: str, name: str) -> Estimate | None:
    value, ends = entry[key].get(name), entry[f"{key}_ci95"].get(name)
    return None if value is None or ends is None else Estimate(float(value), float(ends[0]), float(ends[1]))
