"""A replay's result on the terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console

from osel_sim.cli.budget_table import print_budget
from osel_sim.cli.console import MOST_POLICIES, Table, number, percent, plain


def print_replay(console: Console, result: Mapping[str, Any]) -> None:
    """Print the selectors from best to worst, the oracles, and the verdict."""
    log, learnable = result["log"], result["learnable_oracle"]["name"]
    title = f"{_few(log['tasks'], 'tasks')}: {result['decisions']} decisions of {log['instances']} instances, {len(result['seeds'])} seeds"
    headings = ("mean reward [95%]", "success", "seconds", "cents", "gap closed [95%]", "last quarter [95%]", "regret", "ahead at")
    table = Table(title, [""], headings)
    fixed = 0
    for name, entry in sorted(result["selectors"].items(), key=lambda item: -item[1]["mean_reward"]):
        if name in ("best_single", "worst_single"):
            continue
        fixed += entry["kind"] == "fixed"
        if entry["kind"] == "fixed" and fixed > MOST_POLICIES:
            continue
        best = result["selectors"]["best_single"]["policy"] == entry.get("policy")
        table.add(
            name + (" (best)" if best else ""),
            _with_interval(entry["mean_reward"], entry["ci95"]),
            percent(entry["success_rate"]),
            number(entry["mean_seconds"]),
            number(entry["mean_price"]),
            percent(entry["learnable_gap_closed"], entry["learnable_gap_closed_ci95"]),
            percent(entry["learnable_gap_closed_late"], entry["learnable_gap_closed_late_ci95"]),
            number(entry["regret"].get(learnable), 3),
            "-" if entry["decisions_until_ahead"] is None else str(entry["decisions_until_ahead"]),
        )
    table.add_section()
    for name, entry in result["oracles"].items():
        if name != "best_single":
            table.add(f"{name.replace('_', ' ')} oracle", _with_interval(entry["mean_reward"], entry["ci95"]))
    console.print(table)
    if fixed > MOST_POLICIES:
        console.print(f"{fixed - MOST_POLICIES} more policies earn less alone than those shown; selectors.csv has them")
    by = f"gap closed and regret: by the {learnable} oracle; " if learnable else ""
    notes = [f"{by}ahead at: from that decision on the sum of rewards exceeds the best policy's"]
    gains = [f"{name.replace('_', ' ')} {_gain(entry)}" for name, entry in result["oracles"].items() if name != "best_single"]
    notes.append(f"oracles over the best single policy, with intervals over instances: {', '.join(gains)}")
    for oracle, selector in result["learnable_oracle"]["beaten"].items():
        notes.append(f"The {oracle.replace('_', ' ')} oracle is left out: {selector} earned more, so it bounds nothing here.")
    learners = {name: entry for name, entry in result["selectors"].items() if entry["kind"] == "learner"}
    if learnable == "expected" and "predictable" in result["oracles"] and learners:
        best = max(learners, key=lambda name: float(learners[name]["mean_reward"]))
        whole, late = (
            percent(learners[best][f"predictable_gap_closed{part}"], learners[best][f"predictable_gap_closed{part}_ci95"]) for part in ("", "_late")
        )
        notes.append(f"of the gap to the predictable oracle {best} closed {whole}, in the last quarter {late}")
    if learnable == "predictable":
        notes.append("the predictable oracle is a router trained on all outcomes of one half of the instances and scored on the other half")
    if result["log"]["left_out"]["instances"]:
        notes.append(f"{log['left_out']['instances']} instances without an outcome of every policy were left out.")
    if choice := log.get("encoder_choice"):
        notes.append(choice["text"])
    print_budget(console, result.get("budget"))
    for note in notes:
        console.print(plain(note))
    console.print(plain(result["verdict"]["text"], "bold"), soft_wrap=True)


def print_so_far(console: Console, result: Mapping[str, Any]) -> None:
    """Print the verdict while not all is replayed yet, what it rests on, and what is to come."""
    learners = [name for name, entry in result["selectors"].items() if entry["kind"] == "learner"]
    console.print(plain(f"So far, from {_few(learners, 'selectors')} and the fixed policies:"), soft_wrap=True)
    console.print(plain(result["verdict"]["text"], "bold"), soft_wrap=True)
    console.print(plain(f"Still being replayed: {', '.join(result['pending'])}; Ctrl-C keeps what is there"), soft_wrap=True)


def _gain(entry: Mapping[str, Any]) -> str:
    ends = entry["gain_ci95"]
    return f"{entry['gain']:+.3f}" + (f" [{ends[0]:+.3f}, {ends[1]:+.3f}]" if ends else "")


def print_off_policy(console: Console, found: Mapping[str, Any]) -> None:
    """Print what other ways of choosing would have earned in a live run."""
    run = found["run"]
    title = f"{run['selector']}, {run['decisions']} decisions: what others would have earned"
    table = Table(title, [""], ("measured", "IPS [95%] (n)", "SNIPS [95%] (n)", "DR [95%] (n)"))
    table.add(f"{run['selector']} (as it was)", _with_interval(run["mean_reward"], run["ci95"]), "", "", "")
    table.add_section()
    for name, entry in found["targets"].items():
        cells = [_estimate(entry, way) for way in ("ips", "snips", "dr")]
        table.add(name + (" (unsupported)" if entry["unsupported"] else ""), number(entry["measured"], 3), *cells)
    console.print(table)
    console.print("n: effective decisions, that is how many made that way would weigh as much; an estimate that rests on too few is not shown")
    if run["errors"]:
        console.print(f"{run['errors']} decisions that ended in error were left out.")


def _estimate(entry: Mapping[str, Any], way: str) -> str:
    """An estimate with the number of decisions that it rests on."""
    shown = "-" if entry[way] is None or way in entry["few"] else _with_interval(entry[way], entry[f"{way}_ci95"])
    return f"{shown} ({entry[f'{way}_effective']:.0f})"


def _few(names: Sequence[str], what: str) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more {what}" if len(names) > 3 else "")


def _with_interval(value: float, interval: Sequence[float] | None) -> str:
    if interval is None:
        return f"{value:.3f}"
    return f"{value:.3f} [{interval[0]:.3f}, {interval[1]:.3f}]"
