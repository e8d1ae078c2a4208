"""A log replayed to several robots at once: what sharing is worth, against each alone and against one that sees everything."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.engine import WARM, Setup
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.one_thread import played
from osel_sim.analysis.streams import Streams, draw_streams
from osel_sim.analysis.warm_start import show
from osel_sim.core.torch_settings import threads_where_imported
from osel_sim.interface.selector import Selector, SelectorFactory
from osel_sim.selection.dealing import By, deal, groups
from osel_sim.selection.fleet import Fleet, Sharing, robot_seed
from osel_sim.statistics.intervals import bootstrap_mean_interval

SOON = ("auto", "epsilon_greedy", "lints", "linucb", "thompson", "ucb1")
"""Selectors that are replayed to robots unless it is said which: those that can share and take seconds, not hours."""
POINTS = 100
"""A curve has at most so many."""
RESAMPLES = 10_000


@dataclass(frozen=True)
class Robots:
    """Who learns from what.

    Attributes:
        count: of the robots.
        sharing: what they exchange; `none` and `all` are replayed beside it.
        by: what their streams differ in; None: nothing.
        decisions: length of a stream before it is dealt out; None: all instances.
    """

    count: int
    sharing: Sharing
    by: By | None = None
    decisions: int | None = None

    @property
    def ways(self) -> dict[str, Sharing]:
        """What is compared: each alone, as asked, and one that sees everything."""
        alone, central = Sharing(), Sharing(central=True)
        return {str(way): way for way in (alone, self.sharing, central)}


@dataclass(frozen=True)
class Dealt:
    """What is replayed to the robots.

    Attributes:
        seeds: of the streams, and of the selectors.
        owners: (N,) robot of every instance of the log; None: instances are dealt out in turn.
    """

    streams: Streams
    seeds: tuple[int, ...]
    owners: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class _Material:
    """What workers need: as `osel_sim.analysis.engine` has it, and the places of each seed's stream at which each robot decides, (rounds, robots)."""

    contexts: NDArray[np.float32]
    rewards: NDArray[np.float64]
    policies: tuple[str, ...]
    streams: Streams
    seeds: tuple[int, ...]
    places: tuple[NDArray[np.int64], ...]
    setup: Setup
    robots: Robots
    factories: Mapping[str, SelectorFactory]


_Job = tuple[str, str, int]
"""Selector, way to share, position of the seed."""
_Played = tuple[NDArray[np.float64], float]
"""Rewards (rounds, robots), and the mean number of bytes of a message."""


def share_log(
    log: LoggedOutcomes,
    setup: Setup,
    selectors: Sequence[str],
    robots: Robots,
    seeds: Sequence[int],
    workers: int = 1,
    count: Callable[[int], Any] = lambda decisions: None,
    factories: Mapping[str, SelectorFactory] | None = None,
) -> dict[str, Any]:
    """Replay a log to robots that share as asked, to robots that do not, and to one selector for all of them.

    Args:
        log: complete instances only. setup, seeds, workers, factories: as `osel_sim.analysis.engine` has them.
        selectors: those that can share (`osel_sim.selection.registry.check_can_share`).
        count: called with every job's number of decisions.

    Returns:
        what `replay.json` has as `sharing`; see `docs/sharing.md`.

    Raises:
        UsageError: too few tasks, levels or arms for so many robots, or streams too short.
    """
    owners = None
    if robots.by is not None:
        values = [getattr(instance, robots.by) for instance in log.instances]
        owner = groups(values, robots.count, robots.by)
        owners = np.array([owner[value] for value in values], np.int64)
    streams = draw_streams(log.rewards(setup.weights), seeds, robots.decisions)
    return share_streams(log, setup, selectors, robots, Dealt(streams, tuple(seeds), owners), workers, count, factories)


def share_streams(
    log: LoggedOutcomes,
    setup: Setup,
    selectors: Sequence[str],
    robots: Robots,
    dealt: Dealt,
    workers: int = 1,
    count: Callable[[int], Any] = lambda decisions: None,
    factories: Mapping[str, SelectorFactory] | None = None,
) -> dict[str, Any]:
    """The same with streams that were drawn already; arguments, result and errors are those of `share_log`."""
    streams, seeds = dealt.streams, dealt.seeds
    places = [deal(dealt.owners, order, robots.count) for order in streams.order]
    rounds = min(map(len, places))
    cut = tuple(own[:rounds] for own in places)
    material = _Material(log.contexts, log.rewards(setup.weights), log.policies, streams, seeds, cut, setup, robots, factories or {})
    jobs = [(name, way, seed) for name in selectors for way in robots.ways for seed in range(len(seeds))]
    found: dict[_Job, _Played] = {}
    with closing(played(partial(_play, material), jobs, workers)) as results:
        for job, one in results:
            found[job] = one
            count(one[0].size)
    return {
        "robots": robots.count,
        "by": robots.by,
        "share": str(robots.sharing),
        "delay": robots.sharing.delay,
        "decisions": rounds,
        "at": (_thinned(rounds) + 1).tolist(),
        "selectors": {name: _entry(name, robots, found, len(seeds)) for name in selectors},
    }


def share_total(robots: Robots, selectors: Sequence[str], seeds: int, decisions: int) -> int:
    """How many decisions `share_log` makes at most."""
    return len(robots.ways) * len(selectors) * seeds * decisions


def _entry(name: str, robots: Robots, found: Mapping[_Job, _Played], seeds: int) -> dict[str, Any]:
    """What a selector came to, by way to share."""
    tables = {way: np.stack([found[name, way, seed][0] for seed in range(seeds)]) for way in robots.ways}
    means = {way: table.mean(axis=(1, 2)) for way, table in tables.items()}
    share = str(robots.sharing)
    closed, ends, gain = _closed(means["none"], means[share], means["all"])
    return {
        "ways": {way: _way(tables[way], means[way]) for way in robots.ways},
        "gain": gain[0],
        "gain_ci95": gain[1],
        "gap_closed": closed,
        "gap_closed_ci95": ends,
        "message_bytes": float(np.mean([found[name, share, seed][1] for seed in range(seeds)])),
    }


def _way(table: NDArray[np.float64], means: NDArray[np.float64]) -> dict[str, Any]:
    at = _thinned(table.shape[1])
    curves = table.mean(axis=2).cumsum(axis=1) / np.arange(1, table.shape[1] + 1)
    several = len(means) > 1
    spread = 1.96 * curves.std(axis=0, ddof=1) / np.sqrt(len(curves)) if several else None
    return {
        "mean_reward": float(means.mean()),
        "ci95": list(bootstrap_mean_interval(means)) if several else None,
        "curve": curves.mean(axis=0)[at].tolist(),
        "spread": None if spread is None else spread[at].tolist(),
    }


def _closed(
    alone: NDArray[np.float64], shared: NDArray[np.float64], whole: NDArray[np.float64]
) -> tuple[float | None, list[float] | None, tuple[float, list[float] | None]]:
    """Share of the gap between alone and all-seeing that sharing closes, and the gap, with 95% intervals over the seeds, which are paired.

    None where the gap is not clear of 0: a share of nothing says nothing.
    """
    gap = float(whole.mean() - alone.mean())
    if len(alone) < 2:
        return (float((shared.mean() - alone.mean()) / gap) if gap > 0 else None), None, (gap, None)
    rows = np.random.default_rng(0).integers(len(alone), size=(RESAMPLES, len(alone)))
    gaps, gains = (whole - alone)[rows].mean(axis=1), (shared - alone)[rows].mean(axis=1)
    ends = np.quantile(gaps, [0.025, 0.975]).tolist()
    if ends[0] <= 0:
        return None, None, (gap, ends)
    return float((shared.mean() - alone.mean()) / gap), np.quantile(gains / np.maximum(gaps, 1e-12), [0.025, 0.975]).tolist(), (gap, ends)


def _thinned(rounds: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, rounds - 1, min(POINTS, rounds)).round().astype(np.int64))


def _play(material: _Material, job: _Job) -> _Played:
    """Show its stream to the robots of one seed, each of which sees the rewards of its choices only."""
    name, way, number = job
    robots = material.robots
    fleet = Fleet(partial(_selector, material, name, number), robots.count, robots.ways[way])
    fleet.begin()
    with threads_where_imported(1):  # by now selectors that need torch have imported it
        return _through(fleet, material, number)


def _through(fleet: Fleet, material: _Material, number: int) -> _Played:
    """Show the stream of one seed to its robots."""
    streams = material.streams
    rewards = streams.rewards(material.rewards, number)
    contexts = material.contexts[streams.order[number]]
    contexts.flags.writeable = False
    places, column = material.places[number], {policy: index for index, policy in enumerate(material.policies)}
    received = np.zeros(places.shape)
    for step, now in enumerate(places):
        for robot, place in enumerate(now):
            choice = fleet.select(robot, contexts[place])
            received[step, robot] = rewards[place, column[choice.policy]]
            fleet.update(robot, contexts[place], choice, float(received[step, robot]))
        fleet.end_round()
    return received, fleet.message_bytes


def _selector(material: _Material, name: str, number: int, robot: int) -> Selector:
    """A robot's selector, as `replay_one` makes that of a stream."""
    from osel_sim.selection.registry import make_selector

    seed, setup = robot_seed(material.seeds[number], robot), material.setup
    size, factory = material.contexts.shape[1], material.factories.get(name)
    if factory is not None:
        return factory(material.policies, size, seed)
    selector = make_selector(name.removesuffix(WARM), material.policies, size, seed, **setup.settings.get(name, {}))
    if name.endswith(WARM) and setup.warm_start is not None:
        show(selector, setup.warm_start, material.policies, material.seeds[number])
    return selector
