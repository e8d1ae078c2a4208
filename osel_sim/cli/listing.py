"""The tasks, robots, policies and suites there are, for `python -m osel_sim.run --list`: reads TOML and imports no simulator."""

import contextlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from osel_sim.core import content
from osel_sim.core.errors import OselError
from osel_sim.core.shown import all_shown
from osel_sim.formats.policy_file import PolicySpec, load_policy_file
from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.sim.robots import ROBOTS
from osel_sim.suites import SUITES


def listing(tasks: Path | None = None, policies: Path | None = None) -> dict[str, list[dict[str, Any]]]:
    """All tasks, robots, policies and suites of others, by name, as plain data.

    Args:
        tasks: a folder of the user's own task files.
        policies: a folder of the user's own policy files.

    Raises:
        ContentError: a file is wrong.
    """
    return {
        "tasks": [_task(load_task_file(file)) for _, file in sorted(content.files("tasks", tasks).items())],
        "robots": [{"name": name} for name in sorted(ROBOTS.locations())],
        "policies": [_policy(load_policy_file(file)) for _, file in sorted(content.files("policies", policies).items())],
        "suites": [_suite(name) for name in SUITES.others()],
    }


def print_listing(as_json: bool = False, tasks: Path | None = None, policies: Path | None = None) -> None:
    """Print the listing as tables, or as JSON."""
    with contextlib.redirect_stdout(sys.stderr):  # what plugins print while they load is no part of it
        found = listing(tasks, policies)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    from osel_sim.cli.console import Table, console, plain

    columns = ("task", "title", "tags", "steps")
    table = Table("Tasks", columns)
    for task in found["tasks"]:
        table.add(task["name"], task["title"], ", ".join(task["tags"]), str(task["horizon"]))
    console().print(table)
    console().print(f"Robots, for --robot: {', '.join(robot['name'] for robot in found['robots'])}; {DEFAULT_ROBOT} unless a task file names another")
    for suite in found["suites"]:
        table = Table(f"Tasks of {suite['name']}: {suite['title']}", columns)
        for task in suite["tasks"]:
            table.add(task["name"], task["title"], ", ".join(task["tags"]), str(task["horizon"]))
        console().print(table if suite["problem"] is None else plain(f"{suite['name']}: {suite['problem']}"))
    table = Table("Policies", ("policy", "title", "where", "kind"))
    for policy in found["policies"]:
        where = "local" if policy["remote"] is None else f"remote ({policy['remote']['network']})"
        table.add(policy["name"], policy["title"], where + (", privileged" if policy["privileged"] else ""), policy["kind"])
    console().print(table)


def _task(task: TaskSpec) -> dict[str, Any]:
    return {
        "name": task.name,
        "title": task.title,
        "version": task.version,
        "tags": list(task.tags),
        "horizon": task.horizon,
        "objects": [entity.name for entity in task.of_kind("object")],
        "containers": [entity.name for entity in task.of_kind("container")],
        "phrasings": {"train": len(task.train), "held_out": len(task.held_out)},
        "file": str(task.file),
    }


def _suite(name: str) -> dict[str, Any]:
    """A suite of others; one that cannot be loaded says why, and keeps nobody from the rest of the listing."""
    from osel_sim.interface.suite import Task  # imports numpy
    from osel_sim.suites.registry import load_suite

    try:
        suite = load_suite(name)
        tasks = [
            {"name": Task(suite, short).name, "title": info.title, "tags": list(info.tags), "horizon": info.horizon}
            for short, info in suite.tasks.items()
        ]
    except OselError as error:
        return {"name": name, "title": "", "tasks": [], "problem": str(error)}
    return {"name": name, "title": suite.spec.title, "tasks": tasks, "problem": None}


def _policy(policy: PolicySpec) -> dict[str, Any]:
    location = "remote" if policy.is_remote else "local"
    found: dict[str, Any] = all_shown(asdict(policy))  # without the login and query of an address
    return {**found, "location": location, "privileged": policy.is_privileged, "file": str(policy.file)}
