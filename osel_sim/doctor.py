"""What works here, what is missing and which command fixes it: `python -m osel_sim.doctor`. With --policy: how a policy is connected."""

import contextlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from osel_sim.api.settings import MAIN, ContentSettings, Index, settings
from osel_sim.cli.command import Command
from osel_sim.cli.machine_checks import MISSING, NOTE, OK, Check, examine
from osel_sim.core.trust import trusting

EXAMPLES = """examples:
  python -m osel_sim.doctor
  python -m osel_sim.doctor --json | python -m json.tool
  python -m osel_sim.doctor --policy local_small                        runs one instance: what the policy saw, did, and how it ended
  python -m osel_sim.doctor --policy my_policies/pi0.toml --task pick_place

Exit code: 0 if everything needed for a run is there, 1 if something is missing (with --policy: if something is wrong with how it is connected)."""


@settings
class DoctorConfig(ContentSettings):
    """Report what works on this machine, what is missing and which command fixes it."""

    policy: Annotated[str | None, MAIN] = None
    """name or file of a policy: run one instance with it and report on it"""
    task: Annotated[str, MAIN] = "pick_place"
    """task of that instance; of other suites SUITE:TASK"""
    seed: Annotated[Index, MAIN] = 0
    """seed of that instance"""
    level: Annotated[Index, MAIN] = 0
    """its level"""
    robot: Annotated[str | None, MAIN] = None
    """its robot, such as UR5e (default: the one the task file names, else Panda)"""
    out: Annotated[Path | None, MAIN] = None
    """where its pictures go (default: runs/doctor/POLICY)"""
    json: Annotated[bool, MAIN] = False
    """print JSON"""


def _execute(config: DoctorConfig) -> int:
    if config.policy is not None:
        with trusting(config.trust):
            return _examine_policy(config, config.policy)
    with contextlib.redirect_stdout(sys.stderr):  # what plugins print while they load is no part of it
        checks = examine(config.tasks, config.policies_dir)
    ready = all(check.state != MISSING for check in checks)
    if config.json:
        print(json.dumps({"ready": ready, "checks": [asdict(check) for check in checks]}, indent=2))
    else:
        _print(checks, ready)
    return 0 if ready else 1


def _examine_policy(config: DoctorConfig, policy: str) -> int:
    from osel_sim.cli.policy_report import print_report
    from osel_sim.episodes.policy_check import check_policy, find_policy
    from osel_sim.suites.registry import find_task

    spec, folder = find_policy(policy, config.policies_dir)
    out = config.out or Path("runs") / "doctor" / spec.name
    task = find_task(config.task, config.tasks, config.robot)
    report = check_policy(spec, task, config.seed, config.level, out, folder)
    if config.json:
        print(json.dumps(asdict(report), indent=2))
    else:
        print_report(report, out)
    return 0 if report.sound else 1


def _print(checks: list[Check], ready: bool) -> None:
    from osel_sim.cli.console import Table, console, plain

    colours = {OK: "green", NOTE: "yellow", MISSING: "red"}
    table = Table("", ["", "area", "what", "found", "to put it right"])
    for check in checks:
        table.add(plain(check.state, colours[check.state]), check.area, check.name, check.found, check.fix)
    console().print(table)
    missing = sum(check.state == MISSING for check in checks)
    console().print("ready to run" if ready else f"{missing} {'thing is' if missing == 1 else 'things are'} missing")


main = Command("doctor", DoctorConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
