"""Outcome tables of others: how they are read, what their columns mean, and how they become a rollout log."""
