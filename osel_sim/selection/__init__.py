"""Selectors: who chooses a policy for an instance and learns from it; rewards, oracles, and the selection problem as an environment."""
