"""What a monitor is: at decision points within an episode it says who drives on, and learns from what became of that."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.interface.outcome import Outcome

Picture = NDArray[np.float32]
"""The encoder's context (d,) of what is to be seen at a decision point, with the instruction."""


@dataclass(frozen=True)
class Candidate:
    """A policy that may drive.

    Attributes:
        remote: it runs behind a network, and its driving counts as duty.
    """

    name: str
    remote: bool


class Look(Protocol):
    """What a monitor may look at more closely at a decision point; made when it is asked for, and only then paid."""

    def picture(self) -> Picture:
        """The encoder's picture of now, float32 (d,): a rendering and an encoding of this machine's time."""
        ...

    def change(self) -> float | None:
        """How far the camera's image differs from the one at the decision point before: mean absolute difference of pixels as a share of their range,
        in [0, 1]. None at the first one, or where nobody looked there. A rendering of this machine's time."""
        ...

    def difference(self, policy: str) -> float | None:
        """Ask another policy for a chunk, and say how far it differs from what is left of the driver's (as `DecisionPoint.overlap` measures it).

        That costs what a call costs, in cents and in time, while the robot waits. Where the monitor then hands over to that policy, the chunk is its
        first. None where it gave no answer, or nothing is left of the driver's chunk.
        """
        ...


@dataclass(frozen=True)
class Told:
    """What was looked at, as it was written down.

    Attributes:
        picture_then: None where nobody looked.
        changes: (), or the one value of `change`.
        differences: of the policies that were asked.
    """

    picture_then: Picture | None = None
    changes: tuple[float | None, ...] = ()
    differences: Mapping[str, float | None] = field(default_factory=dict)

    def picture(self) -> Picture:
        """As `Look.picture`.

        Raises:
            DataError: it was not looked at.
        """
        if self.picture_then is None:
            raise DataError("no picture was kept of this decision point")
        return self.picture_then

    def change(self) -> float | None:
        """As `Look.change`.

        Raises:
            DataError: it was not looked at.
        """
        if not self.changes:
            raise DataError("no change of the image was kept of this decision point")
        return self.changes[0]

    def difference(self, policy: str) -> float | None:
        """As `Look.difference`; costs nothing any more.

        Raises:
            DataError: it was not asked.
        """
        if policy not in self.differences:
            raise DataError(f"policy {policy!r} was not asked at this decision point")
        return self.differences[policy]


@dataclass(frozen=True, eq=False)
class DecisionPoint:
    """A call of an episode at which who drives may change, before it is made: what a monitor is shown. None of it is the simulator's state.

    Attributes:
        call: calls of the episode so far, whoever drove; those by which a monitor asked for a second opinion do not count.
        step: control steps so far.
        seconds: so far, as the reward counts them (`osel_sim.selection.reward.total_seconds`).
        price: cents so far.
        time_used: share of the horizon that is used up, in [0, 1].
        driver: who drives.
        instruction: what is to be done.
        overlap: how far the driver's last two chunks differ in the actions that both planned for the same moments: root mean square over the motions,
            in half ranges of an action (so that 2 is from one end to the other). None after its first call, or where its chunks do not overlap.
        moved: how far `observation.state` is from what it was at the decision point before (the episode's start at the first): root mean square over
            its numbers, in their own units. None where the environment has no state.
        look: what may be looked at more closely.
    """

    call: int
    step: int
    seconds: float
    price: float
    time_used: float
    driver: str
    instruction: str
    overlap: float | None
    moved: float | None
    look: Look = field(repr=False)


@dataclass(frozen=True)
class Turn:
    """Who drives on from a decision point.

    Attributes:
        policy: the driver, or the one that is handed over to.
        why: a few words, for journals and pages.
        propensities: probability with which each policy would have been chosen; None: this one, for certain.
    """

    policy: str
    why: str = ""
    propensities: Mapping[str, float] | None = None

    def check(self, policies: Sequence[str]) -> None:
        """Refuse a turn of none of the policies, or with propensities that are none.

        Raises:
            UnknownNameError: no such policy.
            UsageError: the propensities are not probabilities of the policies, or the one chosen has none.
        """
        if self.policy not in policies:
            raise UnknownNameError("policy", self.policy, policies, "a monitor hands over to one of those")
        chances = self.propensities
        if chances is None:
            return
        total = math.fsum(chances.values())
        if not abs(total - 1.0) < 1e-6 or min(chances.values()) < 0.0 or not set(chances) <= set(policies) or not chances.get(self.policy, 0.0) > 0.0:
            raise UsageError(f"propensities of a turn must be >= 0, sum to 1 and hold {self.policy!r}, got {dict(chances)}")


@dataclass(frozen=True)
class Watched:
    """An episode that is over, for a monitor to learn from.

    Attributes:
        points, turns: its decision points, and who drove on from each.
        outcome: what came of it.
        reward: of the whole episode.
        to_go: (len(points),) reward-to-go of each point: `reward` without what its time and price so far took off it.
    """

    points: Sequence[DecisionPoint]
    turns: Sequence[Turn]
    outcome: Outcome
    reward: float
    to_go: Sequence[float]


class Monitor(Protocol):
    """Looks at decision points and says who drives on. For each episode `reset`, then `drives_on` at each point, then `learn` unless it was an error.

    The same episodes in the same order give the same turns: all chance comes from the seeds it is given. That is how a run is resumed: the journal's
    episodes are told again.
    """

    def reset(self, instruction: str, driver: str, seed: tuple[int, ...]) -> None:
        """A new episode.

        Args:
            driver: who drives first.
            seed: integers >= 0 that fix the chance of this episode.
        """
        ...

    def drives_on(self, point: DecisionPoint) -> Turn:
        """Who drives on."""
        ...

    def learn(self, watched: Watched) -> None:
        """Learn from an episode that is over; also one that another monitor watched, as of a log."""
        ...


MonitorFactory = Callable[..., Monitor]
"""Makes a monitor: called with the candidates (`Candidate`), the length of a picture, a seed, and the parameters that followed its name as texts, as
`8` and `remote_large` of `blind:8:remote_large`. What is wrong with those it says by a `UsageError`."""
