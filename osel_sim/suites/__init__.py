"""Suites by name, and what those of others are made of."""

from typing import Any

from osel_sim.core.registry import Registry

RESERVED = ("osel_sim", "all", "tag", "skill")
"""Not for suites of others: ours, `all` and `tag:` select tasks, and `skill:` begins the keys of examples among the contexts of instances."""

SUITES = Registry[Any]("suite", "osel_sim.suites", {}, reserved=RESERVED)
"""Suites of others."""
