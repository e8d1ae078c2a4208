"""What sharing was worth to the robots of a live run: what each earned, when it was told of the others, and the same streams played again."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from osel_sim.analysis.engine import Setup
from osel_sim.analysis.live import LiveLog
from osel_sim.analysis.sharing import SOON, Dealt, Robots, share_streams
from osel_sim.analysis.streams import complete_instances, draw_streams
from osel_sim.analysis.told import told
from osel_sim.core.errors import DataError, OselError, UsageError
from osel_sim.selection.fleet import Sharing
from osel_sim.selection.reward import RewardWeights

ORDERS = 20
"""In so many orders the streams are played again, the first of them the run's own."""


@dataclass(frozen=True)
class RunFleet:
    """The robots of a live run; decision t is robot t mod `count`'s.

    Attributes:
        by: what their streams differ in; None: nothing.
    """

    count: int
    sharing: Sharing
    by: str | None = None

    def arrivals(self, decisions: int) -> list[int]:
        """After how many decisions of its own each robot knew of an exchange, up to so many; nothing of robots that exchange nothing."""
        every, delay = self.sharing.every, self.sharing.delay
        return [] if every is None else [sent + delay for sent in range(every, decisions + 1, every) if sent + delay <= decisions]


def fleet_of(live: LiveLog) -> RunFleet | None:
    """The robots of a live run; None where there was but one.

    Raises:
        DataError: `fleet` of its configuration is of another form.
    """
    said = live.outcomes.metadata.get("fleet")
    if said is None:
        return None
    where = f"{live.outcomes.source}: configuration.fleet of run.json"
    if not isinstance(said, Mapping):
        raise DataError(f"{where} is {said!r}, not a table")
    count, share, delay, by = (said.get(name) for name in ("robots", "share", "delay", "by"))
    if type(count) is not int or count < 2:
        wrong = "robots"
    elif not isinstance(share, str):
        wrong = "share"
    elif type(delay) is not int or delay < 0:
        wrong = "delay"
    elif by not in (None, "task", "level", "robot"):
        wrong = "by"
    else:
        try:
            return RunFleet(count, Sharing.parse(share, delay), by)
        except OselError as error:
            raise DataError(f"{where}: {error}") from None
    raise DataError(f"{where}: {wrong} is {said.get(wrong)!r}, which no run writes")


def played_again(live: LiveLog, fleet: RunFleet, weights: RewardWeights, budget: int) -> dict[str, Any] | str:
    """What `replay.json` has as `sharing`, of the run's instances and its selector: each robot alone, as they shared, and one that sees everything.

    Every robot gets the instances that it had, first in the run's order and then in others.

    Args:
        budget: decisions to replay at most.

    Returns:
        a sentence instead, where it cannot be had.
    """
    if live.selector not in SOON:
        return f"The page plays runs of {', '.join(SOON)} again, and not those of {live.selector}."
    try:
        log, _ = complete_instances(live.outcomes.with_tasks() if live.outcomes.metadata.get("context") else live.outcomes, weights)
    except DataError:
        return "The outcomes of the policies that were not chosen are not known, so that the run cannot be played again otherwise."
    place = {instance.key: index for index, instance in enumerate(live.outcomes.instances)}
    owners = np.array([place[key] % fleet.count for key in log.keys], np.int64)
    if len(set(owners.tolist())) < fleet.count:
        return "Some robot has no instance yet on which the outcome of every policy is known."
    robots = Robots(fleet.count, fleet.sharing, None, min(len(log), max(fleet.count, budget // (2 * 3))))
    setup = Setup(weights, told(log, log, weights, [live.selector]))
    seeds = range(min(ORDERS, max(2, budget // (3 * len(log)))))
    streams = draw_streams(log.rewards(weights), seeds, robots.decisions)
    order = np.concatenate([np.arange(streams.order.shape[1], dtype=np.int32)[None], streams.order[1:]])
    dealt = Dealt(replace(streams, order=order, repeats=np.zeros_like(streams.repeats)), tuple(seeds), owners)
    try:
        found = share_streams(log, setup, [live.selector], robots, dealt)
    except UsageError:
        return "There are too few decisions yet to play them again."
    return found | {"by": fleet.by, "orders": len(seeds)}
