"""An episode with its moments: cut before every K-th call, and from that state every other policy drives on to the end."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.episodes.drivers import Drivers
from osel_sim.episodes.handoffs import Handoffs
from osel_sim.episodes.loop import Moment, run_episode
from osel_sim.episodes.moment import go_on
from osel_sim.formats.moments import SIGNALS, MomentRow
from osel_sim.interface.encoder import Encoder
from osel_sim.interface.environment import Environment
from osel_sim.interface.instance import Instance
from osel_sim.interface.monitor import Candidate, DecisionPoint
from osel_sim.interface.outcome import Outcome
from osel_sim.selection.monitors.unseeing import NeverMonitor


@dataclass(frozen=True)
class Cuts:
    """Where episodes are cut.

    Attributes:
        every: before every so many calls, >= 1.
        most: so many times at most, >= 1; None: until the episode is over.
    """

    every: int
    most: int | None = None


@dataclass(frozen=True)
class Moments:
    """The moments of one episode.

    Attributes:
        rows: the ways on from each, in the order of the table.
        pictures: float32 (m, D), of each moment.
        signals: float64 (m, len(SIGNALS)).
    """

    rows: tuple[MomentRow, ...]
    pictures: NDArray[np.float32]
    signals: NDArray[np.float64]


class _Cutter:
    """Keeps an episode as it is at its decision points, and what is to be seen there."""

    def __init__(self, most: int | None) -> None:
        self._most = most
        self.moments: list[Moment] = []
        self.pictures: list[NDArray[np.float32]] = []
        self.signals: list[list[float]] = []

    def __call__(self, point: DecisionPoint, keep: Any) -> None:
        if self._most is not None and len(self.moments) == self._most:
            return
        change = point.look.change()
        told = {"seconds": point.seconds, "price": point.price, "time_used": point.time_used}
        told |= {name: np.nan if value is None else value for name, value in (("overlap", point.overlap), ("moved", point.moved), ("change", change))}
        self.pictures.append(point.look.picture())
        self.signals.append([told[name] for name in SIGNALS])
        self.moments.append(keep())


@dataclass(frozen=True)
class MomentRunner:
    """Runs episodes with their moments.

    Attributes:
        drivers: of `policies` and their fallbacks.
        policies: names of all that may drive.
        encoder: of the pictures.
        action_noise: as `run_episode` takes it.
    """

    drivers: Drivers
    policies: Sequence[str]
    cuts: Cuts
    encoder: Encoder
    action_noise: float = 0.0

    def run(self, env: Environment, instance: Instance, first: str, horizon: int, repeat: int = 0) -> tuple[Outcome, Moments]:
        """Let `first` drive an episode to its end, then every other policy from each of its moments.

        Args:
            env: holds `instance`, just loaded or restored; has snapshots.
            horizon: control steps after which the episode ends, where `env` does not say.
            repeat: as `run_episode` takes it.

        Returns:
            the outcome of the episode, as `run_episode` gives it without moments, and its moments.
        """
        drivers, cutter = self.drivers, _Cutter(self.cuts.most)
        never = NeverMonitor([Candidate(name, drivers[name].spec.is_remote) for name in self.policies], self.encoder.dimension, 0)
        handoffs = Handoffs(drivers, self.policies, never, self.cuts.every, env.specification.horizon or horizon, self.encoder, cutter)
        driver, fallback = drivers[first], drivers.fallback(first)
        outcome = run_episode(env, instance, driver, fallback, repeat=repeat, action_noise=self.action_noise, handoffs=handoffs)
        rows = []
        for moment in cutter.moments:
            for second in (None, *(name for name in self.policies if name != first)):
                then = outcome if second is None else go_on(moment, second)
                rows.append(_row(instance.key, first, repeat, moment.point, second, then, never.remote))
        pictures = np.array(cutter.pictures, np.float32).reshape(-1, self.encoder.dimension)
        return replace(outcome, monitored=None), Moments(tuple(rows), pictures, np.array(cutter.signals, np.float64).reshape(-1, len(SIGNALS)))


def _row(instance: str, first: str, repeat: int, point: DecisionPoint, second: str | None, outcome: Outcome, remote: Set[str]) -> MomentRow:
    by_policy = {} if outcome.monitored is None else outcome.monitored.by_policy
    own: dict[str, Any] = {name: value for name, value in vars(outcome).items() if name not in ("seconds", "monitored")}
    return MomentRow(
        instance=instance,
        first=first,
        repeat=repeat,
        call=point.call,
        step=point.step,
        second=second,
        **own,
        **vars(outcome.seconds),
        price_first=by_policy[first].price,
        remote_steps=sum(driving.steps for name, driving in by_policy.items() if name in remote),
    )
