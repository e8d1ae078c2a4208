"""What `doctor --policy` found, as tables on the terminal."""

from pathlib import Path

from osel_sim.cli.console import Table, console, plain
from osel_sim.episodes.policy_check import PROBLEM, Report


def print_report(report: Report, out: Path) -> None:
    """The report as tables on the terminal."""
    terminal = console()
    terminal.print(plain(f"{report.policy} on {report.instance}: {report.instruction!r}"))
    saw = Table("What it saw", ["input", "what it was at the first call"])
    for key, words in report.inputs.items():
        saw.add(key, words)
    terminal.print(saw)
    did = Table(f"What it did: {report.calls} calls", ["axis"], ["min", "mean", "max", "std", "at the limit"])
    for axis, row in report.actions.items():
        did.add(axis, *(f"{row[key]:.3f}" for key in ("min", "mean", "max", "std")), f"{row['at_limit']:.0%}")
    terminal.print(did)
    end = report.outcome
    terminal.print(f"{'success' if end['success'] else 'no success'} after {end['steps']} steps, {end['subgoals']:.0%} of the subgoals")
    for kind, words in report.findings:
        terminal.print(plain(kind, "red" if kind == PROBLEM else "yellow") + plain(f" {words}"))
    terminal.print(plain(f"pictures and report.json in {out}"))
