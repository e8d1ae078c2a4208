"""Suites by name, and what those of others are made of."""

from typing import Any

from osel_sim.core.registry import Registry

SUITES = Registry[Any](
    "suite",
    "osel_sim.suites",
    {
        "osel_sim": "osel_sim.sim.suite:OurSuite",
        "metaworld": "osel_sim.suites.metaworld.suite:Metaworld",
        "gym": "osel_sim.suites.gym.suite:Gym",
        "lerobot": "osel_sim.suites.lerobot.suite:LeRobot",
    },
)
"""What makes each suite, ours and those of others; `osel_sim.suites.registry` calls it."""
