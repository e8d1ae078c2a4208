"""Monitors that look at nothing: what those that look must be better than."""

from collections.abc import Sequence
from typing import override

from osel_sim.core.errors import UsageError
from osel_sim.interface.monitor import Candidate, DecisionPoint, Turn, Watched
from osel_sim.selection.monitors.base import MonitorBase, number

PULL = 4.0
"""How strongly `random` makes up for a duty that is off: by so many times the difference."""


class NeverMonitor(MonitorBase):
    """Never hands over."""

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        return Turn(point.driver)


class BlindMonitor(MonitorBase):
    """Hands over once, at the first decision point after so many calls.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
        calls: how many, >= 1 (the parameter K).
        to: whom to; empty: the first policy on the other side of the network.

    Raises:
        UsageError: `calls` is none.
        UnknownNameError: `to` is no candidate.
    """

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int, calls: str, to: str = "") -> None:
        super().__init__(candidates, picture_dim, seed)
        self._calls = int(number(calls, "monitor blind: K", 1, whole=True))
        self._to = self.known(to, "TO of monitor blind") if to else ""
        self._done = False

    @override
    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        super().reset(instruction, driver, seed)
        self._done = False

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        if self._done or point.call < self._calls:
            return Turn(point.driver)
        self._done = True
        return Turn(self._to or self.other(point.driver), f"after {self._calls} calls")


class RandomMonitor(MonitorBase):
    """Draws at each decision point whether a remote policy drives on, so that in the long run those drive a given share of the control steps.

    Who drives first is not its choice, and how long an episode goes on neither. So the probability at a decision point is the share wanted, and
    `PULL` times what the run's duty so far lacks of it, within [0, 1]. Where the side that is drawn is the driver's, it stays; else one of the
    policies there is drawn.

    Args:
        candidates, picture_dim, seed: see `MonitorBase`.
        duty: share of the steps, in [0, 1] (the parameter P).

    Raises:
        UsageError: `duty` is none, or the candidates are all remote or all local, so that it cannot be kept.
    """

    def __init__(self, candidates: Sequence[Candidate], picture_dim: int, seed: int, duty: str) -> None:
        super().__init__(candidates, picture_dim, seed)
        self._duty = number(duty, "monitor random: P", 0.0, 1.0)
        if not 0 < len(self.remote) < len(self.policies):
            raise UsageError("monitor random keeps the share of remote policies: it needs a remote and a local one among --policies")
        self._remote_steps = self._steps = 0.0  # of episodes that are over
        self._since, self._own = 0, 0.0  # of this one

    @override
    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        super().reset(instruction, driver, seed)
        self._since, self._own = 0, 0.0

    @override
    def drives_on(self, point: DecisionPoint) -> Turn:
        if point.driver in self.remote:
            self._own += point.step - self._since
        self._since = point.step
        steps = self._steps + point.step
        lacks = self._duty - (self._remote_steps + self._own) / steps if steps else 0.0
        share = min(1.0, max(0.0, self._duty + PULL * lacks))
        chances = dict.fromkeys(self.policies, 0.0)
        for side, probability in ((True, share), (False, 1.0 - share)):
            names = [name for name in self.policies if (name in self.remote) == side]
            for name in [point.driver] if point.driver in names else names:
                chances[name] += probability / (1 if point.driver in names else len(names))
        policy = self.policies[int(self.chance.choice(len(self.policies), p=list(chances.values())))]
        return Turn(policy, "drawn", chances)

    @override
    def learn(self, watched: Watched) -> None:
        told = watched.outcome.monitored
        if told is not None:
            self._steps += watched.outcome.steps
            self._remote_steps += told.duty_steps * watched.outcome.steps
