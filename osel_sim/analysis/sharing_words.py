"""What is said of robots that share, on the terminal and on the page."""

from collections.abc import Mapping
from typing import Any


def title(sharing: Mapping[str, Any]) -> str:
    """What was replayed to whom."""
    by = f"by {sharing['by']}" if sharing["by"] else "dealt out in turn"
    return f"{sharing['robots']} robots, {sharing['decisions']:,} decisions each, {by}: mean reward"


def about(sharing: Mapping[str, Any]) -> str:
    """What the ways to share are."""
    delay = f", known {sharing['delay']} decisions later" if sharing["delay"] else ""
    exchange = f"{sharing['share']}: exchanged after so many decisions of each{delay}; " if sharing["share"] not in ("none", "all") else ""
    several = next(iter(next(iter(sharing["selectors"].values()))["ways"].values()))["ci95"] is not None
    over = " Intervals are over the orders of the streams." if several else ""
    return f"none: each robot learns alone; {exchange}all: one selector decides for all of them.{over}"


def conclusion(sharing: Mapping[str, Any]) -> str:
    """How much of what one that sees everything has over robots that learn alone sharing closes."""
    entries = {name: entry for name, entry in sharing["selectors"].items() if entry["gap_closed"] is not None}
    if sharing["share"] in ("none", "all"):
        return "Nothing is exchanged in between; --share every:N says what an exchange is worth."
    if not entries:
        return "One that sees everything is not clearly ahead of robots that learn alone here, so that sharing has nothing to close."
    told = ", ".join(f"{name} {100 * entry['gap_closed']:.0f}%" for name, entry in entries.items())
    return f"Of the gap between learning alone and seeing everything, sharing {sharing['share']} closes: {told}."
