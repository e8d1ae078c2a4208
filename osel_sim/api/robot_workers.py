"""Worker processes of a live run: what is asked of them, checked, and made."""

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from osel_sim.api.run_settings import RunConfig
from osel_sim.core.errors import SettingError, UsageError

if TYPE_CHECKING:
    from osel_sim.episodes.live import MakeDecisions
    from osel_sim.episodes.run_subscribers import RunSubscriber
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.suite import Task


def check_workers(config: RunConfig, objects: Collection[str], watchers: "Sequence[RunSubscriber]") -> None:
    """Refuse worker processes where there is nothing for them to do, or something that they cannot do.

    Args:
        objects: names of policies that are objects of this process.
        watchers: subscribers of the caller's own.

    Raises:
        UsageError: there is one robot, or an object of this process drives or watches.
        SettingError: a monitor learns from one decision for the next.
    """
    from osel_sim.episodes.run_subscribers import RunSubscriber

    if config.workers == 1:
        return
    if config.robots == 1:
        raise UsageError(
            f"--workers {config.workers} is for several robots, which decide at the same time; one robot needs what came of a decision for its next: "
            "leave it out, or say with --robots how many there are"
        )
    if config.monitor is not None:
        raise SettingError("workers", "does not go with --monitor, which needs what it saw in a decision for the next; leave one of them out")
    for name in objects:
        raise UsageError(f"workers={config.workers}: policy {name!r} is an object of this process; describe it in a file, or leave workers out")
    for watcher in watchers:
        if type(watcher).watch is not RunSubscriber.watch:
            raise UsageError(
                f"workers={config.workers}: subscriber {type(watcher).__name__} watches episodes, which run in other processes; leave workers out"
            )


def made_by(
    config: RunConfig, tasks: "Sequence[Task]", driving: "Sequence[PolicySpec]", subscribers: "Sequence[RunSubscriber]"
) -> "MakeDecisions | None":
    """What makes the decisions of a live run; None where that is this process.

    Args:
        driving: policies that may drive, and their fallbacks.
        subscribers: of the run.
    """
    if config.workers == 1:
        return None
    from osel_sim.context.names import DEFAULT_ENCODER
    from osel_sim.episodes.robot_workers import Equipment
    from osel_sim.episodes.run_subscribers import Films, Paced
    from osel_sim.episodes.side_by_side import SideBySide

    watching = [one for one in subscribers if isinstance(one, Films | Paced)]
    return SideBySide(config.workers, Equipment(tuple(tasks), tuple(driving), config.encoder or DEFAULT_ENCODER, config.action_noise, watching))
