"""Intervals and bounds."""
