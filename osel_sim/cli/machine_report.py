"""What `doctor` found on this machine, as a table on the terminal."""

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from osel_sim.cli.console import console
from osel_sim.cli.machine_checks import MISSING, NOTE, OK, Check
from osel_sim.cli.next_step import Step, print_next


def print_checks(checks: Sequence[Check], ready: bool, again: list[object]) -> None:
    """The checks as a table, and what to do next.

    Args:
        again: arguments of `doctor` that look at the same.
    """
    colours = {OK: "green", NOTE: "yellow", MISSING: "red"}
    table = Table("", "area", "what", "found", "to put it right")
    for check in checks:
        table.add_row(f"[{colours[check.state]}]{check.state}[/]", check.area, *(escape(text) for text in (check.name, check.found, check.fix)))
    console().print(table)
    missing = sum(check.state == MISSING for check in checks)
    console().print("ready to run" if ready else f"{missing} {'thing is' if missing == 1 else 'things are'} missing")
    run: Step = ("20 live decisions", "run", ["--task", "pick_place", "--policies", "local_small", "remote_large", "--episodes", 20])
    print_next(run if ready else ("looks again, when that is put right", "doctor", again))
