"""Suites by name, and what those of others are made of."""

GROUP = "osel_sim.suites"
"""Entry-point group of suites."""
