"""Several robots in a replay and in a run: what is asked of them, checked."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.api.robot_settings import RobotSettings
from osel_sim.core.errors import SettingError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.analysis.sharing import Robots
    from osel_sim.api.replay_settings import ReplayConfig
    from osel_sim.api.run_settings import RunConfig
    from osel_sim.episodes.run_subscribers import RunSubscriber
    from osel_sim.interface.selector import Selector, SelectorFactory
    from osel_sim.interface.suite import Task
    from osel_sim.selection.fleet import Sharing

SHARE = "every:20"
"""How several robots share unless it is said."""


def sharing_asked(config: RobotSettings) -> "Sharing | None":
    """What robots share; None where there is but one.

    Raises:
        UsageError: something is said of several robots and there is one, or `share` is none of what it may be.
        SettingError: they are to keep to a budget.
    """
    from osel_sim.selection.fleet import Sharing

    if config.robots == 1:
        for name in ("share", "share_delay", "robots_by"):
            if getattr(config, name):
                raise UsageError(f"--{name.replace('_', '-')} is for several robots; say how many with --robots")
        return None
    if getattr(config, "budget_cents", None) is not None:
        raise SettingError("budget_cents", "is for one robot: leave it out, or --robots")
    return Sharing.parse(config.share or SHARE, config.share_delay)


def check_robots(
    config: "RunConfig", tasks: "Sequence[Task]", named: bool, objects: Collection[str] = (), watchers: "Sequence[RunSubscriber]" = ()
) -> "Sharing | None":
    """What the robots of a live run share; None where there is but one.

    Args:
        named: whether the selector is one of the registry's.
        objects: names of policies that are objects of this process.
        watchers: subscribers of the caller's own.

    Raises:
        UsageError: as `sharing_asked`; the selector cannot share; there are fewer tasks, levels or arms than robots; or as `check_workers`.
    """
    from osel_sim.api.robot_workers import check_workers
    from osel_sim.selection.dealing import robots_share
    from osel_sim.selection.registry import check_can_share

    check_workers(config, objects, watchers)
    sharing = sharing_asked(config)
    if sharing is not None:
        if named and sharing.every is not None:
            check_can_share([config.selector])
        robots_share(tasks, config.level, 0, config.robots, config.robots_by)
    return sharing


def fleet_said(config: RobotSettings, sharing: "Sharing | None") -> dict[str, Any]:
    """What a run's configuration says of several robots; nothing where there is but one."""
    if sharing is None:
        return {}
    return {"fleet": {"robots": config.robots, "share": str(sharing), "delay": sharing.delay, "by": config.robots_by}}


def in_turn(config: "RunConfig", sharing: "Sharing | None", make: "Callable[[int], Selector]") -> "Selector":
    """The selector of a live run, or those of several robots as one.

    Args:
        make: makes one of a seed.
    """
    from osel_sim.selection.fleet import Fleet, InTurn, robot_seed

    if sharing is None:
        return make(config.seed)
    return InTurn(Fleet(lambda robot: make(robot_seed(config.seed, robot)), config.robots, sharing))


def robots_asked(
    config: RobotSettings, selectors: Sequence[str], named: bool, own: Collection[str] = (), decisions: int | None = None
) -> "tuple[list[str], Robots] | None":
    """Selectors that are replayed to several robots, and what those share; None where there is one robot.

    Args:
        selectors: all that are replayed.
        named: whether they were named: then all of them must be able to share.
        own: those that are none of the registry's.
        decisions: length of a stream; None: all instances.

    Raises:
        UsageError: a selector that was named cannot share, or as `sharing_asked`.
    """
    from osel_sim.analysis.engine import WARM
    from osel_sim.analysis.sharing import SOON, Robots
    from osel_sim.selection.registry import check_can_share

    sharing = sharing_asked(config)
    if sharing is None:
        return None
    wanted = [name for name in selectors if name != "random" and (named or name in own or name.removesuffix(WARM) in SOON)]
    check_can_share([name.removesuffix(WARM) for name in wanted if name not in own])
    if not wanted:
        raise UsageError("--robots: name a selector that learns, such as --selectors auto")
    return wanted, Robots(config.robots, sharing, config.robots_by, decisions)


def replay_robots(
    log: "LoggedOutcomes",
    setup: "Setup",
    selectors: Sequence[str],
    robots: "Robots",
    config: "ReplayConfig",
    factories: "Mapping[str, SelectorFactory]",
) -> dict[str, Any]:
    """Replay a log to several robots, with a progress bar: what `replay.json` has as `sharing`."""
    from osel_sim.analysis.sharing import share_log, share_total
    from osel_sim.core.progress import progress

    seeds = range(config.seeds)
    total = share_total(robots, selectors, config.seeds, robots.decisions or len(log))
    with progress(total, "decision of robots", scale=True) as bar:
        return share_log(log, setup, selectors, robots, seeds, config.workers, bar.update, factories)
