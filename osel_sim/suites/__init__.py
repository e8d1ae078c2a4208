"""Suites by name, and what those of others are made of; as a command, `python -m osel_sim.suites`."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from osel_sim.core.registry import Registry

SUITES = Registry[Any](
    "suite",
    "osel_sim.suites",
    {
        "osel_sim": "osel_sim.sim.suite:OurSuite",
        "metaworld": "osel_sim.suites.metaworld.suite:Metaworld",
        "gym": "osel_sim.suites.gym.suite:Gym",
        "robosuite": "osel_sim.suites.robosuite.suite:Robosuite",
        "lerobot": "osel_sim.suites.lerobot.suite:LeRobot",
    },
)
"""What makes each suite, ours and those of others; `osel_sim.suites.registry` calls it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code."""
    # By name: what commands share lies above this package, and must not be imported by it.
    code: int = import_module("osel_sim.cli.suites_command").main(arguments)
    return code
