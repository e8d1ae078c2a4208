"""What is said of several robots that learn at once."""

from typing import Annotated, Literal

from osel_sim.api.settings import Count, Group, Index, Settings, settings

ROBOTS = Group("Several robots", 2.5)


@settings
class RobotSettings(Settings):
    """How many robots learn at once, on what, and what they tell one another."""

    robots: Annotated[Count, ROBOTS] = 1
    """so many robots learn at once, each with a selector and a stream of its own"""
    share: Annotated[str | None, ROBOTS] = None
    """none, all (one selector for all robots), or every:N: exchange what was learned after N decisions of each (default: every:20)"""
    share_delay: Annotated[Index, ROBOTS] = 0
    """decisions of each robot until an exchange arrives"""
    robots_by: Annotated[Literal["task", "level", "robot"] | None, ROBOTS] = None
    """what the robots' streams differ in (default: nothing; instances are dealt out in turn)"""
