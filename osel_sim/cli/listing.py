"""What there is to choose from, for `python -m osel_sim.run --list`: reads TOML and imports no simulator."""

import contextlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from osel_sim.api.reward import DEFAULT_PRESET
from osel_sim.context.names import ABOUT, FORMS, PLUGINS, embedded_encoders
from osel_sim.core import content
from osel_sim.core.errors import OselError
from osel_sim.core.shown import all_shown
from osel_sim.formats.policy_file import PolicySpec, load_policy_file
from osel_sim.formats.task_file import TaskSpec, load_task_file
from osel_sim.interface.instance import OURS
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.selection import registry as selectors
from osel_sim.selection.monitors import registry as monitors
from osel_sim.selection.weights import PRESETS
from osel_sim.sim.robots import ROBOTS
from osel_sim.suites import SUITES

MOST_TASKS = 12
"""Of so many tasks of a suite of others the terminal shows a table."""


def listing(tasks: Path | None = None, policies: Path | None = None) -> dict[str, list[dict[str, Any]]]:
    """All tasks, robots, policies, suites of others, selectors, monitors, encoders and reward presets, by name, as plain data.

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
        "suites": [_suite(name) for name in SUITES if name != OURS],
        "selectors": [{"name": name, "about": selectors.ABOUT.get(name, f"of another package ({place})")} for name, place in _selectors()],
        "monitors": [{"name": name, "about": monitors.ABOUT.get(name, f"of another package ({place})")} for name, place in _monitors()],
        "encoders": [{"name": name, "about": about} for name, about in _encoders()],
        "presets": [{"name": name, **asdict(weights)} for name, weights in PRESETS.items()],
    }


def print_listing(as_json: bool = False, tasks: Path | None = None, policies: Path | None = None) -> None:
    """Print the listing as tables, or as JSON."""
    with contextlib.redirect_stdout(sys.stderr):  # what plugins print while they load is no part of it
        found = listing(tasks, policies)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    from osel_sim.cli.console import Table, console, plain
    from osel_sim.cli.next_step import print_next

    columns = ("task", "title", "tags", "steps")
    table = Table("Tasks", columns)
    for task in found["tasks"]:
        table.add(task["name"], task["title"], ", ".join(task["tags"]), str(task["horizon"]))
    console().print(table)
    console().print(f"Robots, for --robot: {', '.join(robot['name'] for robot in found['robots'])}; {DEFAULT_ROBOT} unless a task file names another")
    for suite in found["suites"]:
        table = Table(f"Tasks of {suite['name']}: {suite['title']}", columns)
        if suite["problem"] is None and not 0 < len(suite["tasks"]) <= MOST_TASKS:
            about = f"{len(suite['tasks'])} tasks" if suite["tasks"] else "tasks by name"
            console().print(plain(f"{suite['name']}: {suite['title']}; {about} (python -m osel_sim.suites list --suite {suite['name']})"))
            continue
        for task in suite["tasks"]:
            table.add(task["name"], task["title"], ", ".join(task["tags"]), str(task["horizon"]))
        console().print(table if suite["problem"] is None else plain(f"{suite['name']}: {suite['problem']}"))
    table = Table("Policies", ("policy", "title", "where", "kind"))
    for policy in found["policies"]:
        where = "local" if policy["remote"] is None else f"remote ({policy['remote']['network']})"
        table.add(policy["name"], policy["title"], where + (", privileged" if policy["privileged"] else ""), policy["kind"])
    console().print(table)
    headings = {
        "selectors": "Selectors, for --selector",
        "monitors": "Who drives on within an episode, for --monitor",
        "encoders": "Encoders of contexts, for --encoder",
    }
    for things, heading in headings.items():
        table = Table(heading, ("name", "what it is"))
        for thing in found[things]:
            table.add(thing["name"], thing["about"])
        console().print(table)
    table = Table("Reward weights of the paper, for --preset", ("preset", "reward"))
    for weights in found["presets"]:
        reward = f"{weights['success']} - {weights['alpha_time']:g} {weights['time_unit']} - {weights['alpha_price']:g} cents"
        table.add(weights["name"], reward + (" (default)" if weights["name"] == DEFAULT_PRESET else ""))
    console().print(table)
    names, own = [task["name"] for task in found["tasks"]], ["--tasks", tasks] if tasks is not None else []
    first = "pick_place" if "pick_place" in names else names[0]
    print_next(("runs a task with the selector we recommend", "run", ["--task", first, *own, "--selector", selectors.RECOMMENDED]))


def _selectors() -> list[tuple[str, str]]:
    """Name and place of each, the recommended one first."""
    return sorted(selectors.selector_locations().items(), key=lambda item: (item[0] != selectors.RECOMMENDED, item[0]))


def _monitors() -> list[tuple[str, str]]:
    """Name and place of each."""
    return sorted(monitors.monitor_locations().items())


def _encoders() -> list[tuple[str, str]]:
    """Names and forms of names, with a line about each."""
    own = [(name, ABOUT.get(name, "comes with the package")) for name in embedded_encoders()]
    return [*own, *((name, f"of another package ({PLUGINS.locations()[name]})") for name in PLUGINS.others()), *FORMS.items()]


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
    try:
        from osel_sim.interface.suite import Task  # imports numpy
        from osel_sim.suites.registry import load_suite

        suite = load_suite(name)
        tasks = [
            {"name": Task(suite, short).name, "title": info.title, "tags": list(info.tags), "horizon": info.horizon}
            for short, info in suite.tasks.items()
        ]
    except ModuleNotFoundError as missing:  # a Python without our packages lists what files say
        return {"name": name, "title": "", "tasks": [], "problem": f"needs the package {missing.name!r}, which this Python does not have"}
    except OselError as error:
        return {"name": name, "title": "", "tasks": [], "problem": str(error)}
    return {"name": name, "title": suite.spec.title, "tasks": tasks, "problem": None}


def _policy(policy: PolicySpec) -> dict[str, Any]:
    location = "remote" if policy.is_remote else "local"
    found: dict[str, Any] = all_shown(asdict(policy))  # without the login and query of an address
    return {**found, "location": location, "privileged": policy.is_privileged, "file": str(policy.file)}
