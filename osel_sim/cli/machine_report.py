"""What `doctor` found on this machine, as a table on the terminal."""

from collections.abc import Sequence

from osel_sim.cli.console import Table, console, plain
from osel_sim.cli.machine_checks import MISSING, NOTE, OK, Check
from osel_sim.cli.next_step import Step, print_next


def print_checks(checks: Sequence[Check], ready: bool, again: list[object]) -> None:
    """The checks as a table, and what to do next.

    Args:
        again: arguments of `doctor` that look at the same.
    """
    colours = {OK: "green", NOTE: "yellow", MISSING: "red"}
    table = Table("", ["", "area", "what", "found", "to put it right"])
    for check in checks:
        table.add(plain(check.state, colours[check.state]), check.area, check.name, check.found, check.fix)
    console().print(table)
    missing = sum(check.state == MISSING for check in checks)
    console().print("ready to run" if ready else f"{missing} {'thing is' if missing == 1 else 'things are'} missing")
    run: Step = ("20 live decisions", "run", ["--task", "pick_place", "--policies", "local_small", "remote_large", "--episodes", 20])
    print_next(run if ready else ("looks again, when that is put right", "doctor", again))
