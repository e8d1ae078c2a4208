"""What `doctor --policy` found, as tables on the terminal."""

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from osel_sim.cli.console import console
from osel_sim.episodes.policy_check import PROBLEM, Report


def print_report(report: Report, out: Path) -> None:
    """The report as tables on the terminal."""
    terminal = console()
    terminal.print(escape(f"{report.policy} on {report.instance}: {report.instruction!r}"))
    saw = Table("input", "what it was at the first call", title="What it saw", title_justify="left")
    for key, words in report.inputs.items():
        saw.add_row(escape(key), escape(words))
    terminal.print(saw)
    did = Table("axis", "min", "mean", "max", "std", "at the limit", title=f"What it did: {report.calls} calls", title_justify="left")
    for axis, row in report.actions.items():
        did.add_row(axis, *(f"{row[key]:.3f}" for key in ("min", "mean", "max", "std")), f"{row['at_limit']:.0%}")
    terminal.print(did)
    end = report.outcome
    terminal.print(f"{'success' if end['success'] else 'no success'} after {end['steps']} steps, {end['subgoals']:.0%} of the subgoals")
    for kind, words in report.findings:
        terminal.print(f"[{'red' if kind == PROBLEM else 'yellow'}]{kind}[/] {escape(words)}")
    terminal.print(f"pictures and report.json in {out}")
