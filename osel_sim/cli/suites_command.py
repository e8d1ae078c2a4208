"""`python -m osel_sim.suites list` and `install NAME`: suites of others, and their Python environments."""

import json
import sys
from collections.abc import Sequence
from typing import Annotated, Any

from osel_sim.api.settings import MAIN, Names, Settings, settings
from osel_sim.cli.command import Command, reported
from osel_sim.core.errors import UnknownNameError, UsageError

EXAMPLES = """examples:
  python -m osel_sim.suites list
  python -m osel_sim.suites list --suite metaworld       its tasks
  python -m osel_sim.suites install metaworld            a Python environment of its own for it, in the user's cache folder
"""
ACTIONS = ("list", "install")


@settings
class ListConfig(Settings):
    """List the suites of others: what they are, whether they can run, what they cannot do."""

    suite: Annotated[str | None, MAIN] = None
    """only this one, with its tasks"""
    json: Annotated[bool, MAIN] = False
    """print JSON"""


@settings
class InstallConfig(Settings):
    """Make the Python environments of suites whose packages do not fit ours; nothing where they are there."""

    names: Names
    """which, as `list` shows them"""


def suite_state(name: str) -> dict[str, Any]:
    """What there is to say of a suite, as plain data; `problem` where it cannot be loaded.

    Returns:
        `name`, `title`, `tasks`, `cannot`, `problem`; and `environments`: name, state (`here`, `installed`, `missing`), folder and command of each.
    """
    from osel_sim.core.errors import OselError
    from osel_sim.suites.environments import environment
    from osel_sim.suites.registry import load_suite

    try:
        suite = load_suite(name)
        tasks = [{"name": f"{name}:{short}", "title": info.title, "tags": list(info.tags)} for short, info in suite.tasks.items()]
    except OselError as error:
        return {"name": name, "title": "", "tasks": [], "cannot": [], "environments": [], "problem": str(error)}
    places = [environment(place) for place in suite.spec.environments]
    found = [
        {
            "name": place.name,
            "state": "here" if place.here else "installed" if place.installed else "missing",
            "folder": str(place.folder) if place.installed else None,
            "command": place.command,
        }
        for place in places
    ]
    return {
        "name": name,
        "title": suite.spec.title,
        "tasks": tasks,
        "cannot": list(suite.spec.cannot),
        "environments": found,
        "problem": None,
    }


def state_words(state: dict[str, Any]) -> str:
    """Whether a suite can run, in words."""
    if state["problem"]:
        return str(state["problem"])
    words = {"here": "runs in this process", "installed": "installed, runs in a process of its own", "missing": "not installed: "}
    several = len(state["environments"]) > 1
    parts = [
        (f"{one['name']}: " if several else "") + words[one["state"]] + (one["command"] if one["state"] == "missing" else "")
        for one in state["environments"]
    ]
    return "; ".join(parts) or "runs in this process"


def _list(config: ListConfig) -> int:
    from osel_sim.interface.instance import OURS
    from osel_sim.suites import SUITES

    known = [name for name in SUITES if name != OURS]
    if config.suite is not None and config.suite not in known:
        raise UnknownNameError("suite", config.suite, known)
    states = [suite_state(name) for name in ([config.suite] if config.suite else sorted(known))]
    if config.json:
        print(json.dumps(states, indent=2))
        return 0
    from osel_sim.cli.console import Table, console

    table = Table("Suites of others", ("suite", "what it is", "tasks", "state", "cannot"))
    for state in states:
        tasks = str(len(state["tasks"])) if state["tasks"] else "any"
        table.add(state["name"], state["title"], tasks, state_words(state), "; ".join(state["cannot"]))
    console().print(table)
    if config.suite:
        table = Table(f"Tasks of {config.suite}", ("task", "title", "tags"))
        for task in states[0]["tasks"]:
            table.add(task["name"], task["title"], ", ".join(task["tags"]))
        console().print(table)
    return 0


def _install(config: InstallConfig) -> int:
    from osel_sim.suites.environments import environment

    wanted = [environment(name) for name in config.names]  # all are known, before the first is made
    for place in wanted:
        if not place.installed:
            print(f"{place.name}: installing ...", file=sys.stderr)
        print(f"{place.name}: {place.install()}")
    return 0


commands: dict[str, Command[Any]] = {
    "list": Command("suites list", ListConfig, _list, EXAMPLES),
    "install": Command("suites install", InstallConfig, _install, EXAMPLES),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first word names."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in commands:
        return commands[words[0]](words[1:])
    return reported(lambda: _usage(words))


def _usage(words: Sequence[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(f"Usage: python -m osel_sim.suites {'|'.join(ACTIONS)} [FLAGS]\n\n{EXAMPLES}")
        return 0
    raise UsageError(f"unknown action {words[0]!r}, known: {', '.join(ACTIONS)}")
