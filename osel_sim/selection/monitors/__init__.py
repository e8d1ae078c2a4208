"""Monitors: who drives on at a decision point of an episode."""
