"""What works here, what is missing and which command fixes it: `python -m osel_sim.doctor`. With --policy: how a policy is connected. With --task:
whether the scripted expert can do a task."""

import contextlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from osel_sim.api.settings import MAIN, ContentSettings, Count, Index, settings
from osel_sim.cli.command import Command
from osel_sim.cli.machine_checks import MISSING, examine
from osel_sim.core.trust import trusting

EXAMPLES = """examples:
  python -m osel_sim.doctor
  python -m osel_sim.doctor --json | python -m json.tool
  python -m osel_sim.doctor --policy local_small                        runs one instance: what the policy saw, did, and how it ended
  python -m osel_sim.doctor --policy my_policies/pi0.toml --task pick_place
  python -m osel_sim.doctor --task my_tasks/fetch.toml                  runs the scripted expert: whether the task can be done, and why not

Exit code: 0 if everything needed for a run is there, 1 if something is missing (with --policy: if something is wrong with how it is connected; with
--task alone: if the expert failed on some instance)."""


@settings
class DoctorConfig(ContentSettings):
    """Report what works on this machine, what is missing and which command fixes it."""

    policy: Annotated[str | None, MAIN] = None
    """name or file of a policy: run one instance with it and report on it"""
    task: Annotated[str | None, MAIN] = None
    """task of that instance (default: pick_place), of other suites SUITE:TASK; without --policy the name or file of a task: run the expert on it"""
    instances: Annotated[Count, MAIN] = 5
    """with --task alone: how many the expert is tried on"""
    seed: Annotated[Index, MAIN] = 0
    """seed of the instance, or of the first one"""
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
    if config.task is not None:
        return _examine_task(config, config.task)
    from osel_sim.cli.machine_report import print_checks

    with contextlib.redirect_stdout(sys.stderr):  # what plugins print while they load is no part of it
        checks = examine(config.tasks, config.policies_dir)
    ready = all(check.state != MISSING for check in checks)
    if config.json:
        print(json.dumps({"ready": ready, "checks": [asdict(check) for check in checks]}, indent=2))
    else:
        folders = (("--tasks", config.tasks), ("--policies-dir", config.policies_dir))
        print_checks(checks, ready, [word for flag, folder in folders if folder for word in (flag, folder)])
    return 0 if ready else 1


def _examine_policy(config: DoctorConfig, policy: str) -> int:
    from osel_sim.cli.next_step import print_next
    from osel_sim.cli.policy_report import print_report
    from osel_sim.episodes.policy_check import check_policy, find_policy
    from osel_sim.suites.registry import find_task

    spec, folder = find_policy(policy, config.policies_dir)
    out = config.out or Path("runs") / "doctor" / spec.name
    task = find_task(config.task or "pick_place", config.tasks, config.robot)
    report = check_policy(spec, task, config.seed, config.level, out, folder)
    if config.json:
        print(json.dumps(asdict(report), indent=2))
    else:
        print_report(report, out)
        own = ["--policies-dir", folder] if folder else []
        record = ["--task", task.name, "--policies", spec.name, "local_small", *own, "--instances", 20, "--out", Path("runs") / spec.name]
        print_next(("compares it with another policy", "record", record))
    return 0 if report.sound else 1


def _examine_task(config: DoctorConfig, name: str) -> int:
    from osel_sim.cli.next_step import Step, print_next
    from osel_sim.cli.task_report import find_task_file, print_attempts
    from osel_sim.sim.task_check import check_task

    task, folder = find_task_file(name, config.tasks, config.robot)
    attempts = check_task(task, range(config.seed, config.seed + config.instances), config.level)
    solved = all(attempt.success for attempt in attempts)
    if config.json:
        print(json.dumps({"task": task.name, "solved": solved, "attempts": [asdict(attempt) for attempt in attempts]}, indent=2))
    else:
        print_attempts(task, attempts)
        own: list[object] = ["--tasks", folder] if folder else []
        steps: list[Step] = [("runs it", "run", ["--task", task.name, *own, "--episodes", 20])]
        if not solved:
            steps = [("tries again", "doctor", ["--task", name, *own[: 0 if name.endswith(".toml") else None]])]
        print_next(*steps)
    return 0 if solved else 1


main = Command("doctor", DoctorConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
