"""Handoffs within an episode: who may drive, who decides it, and what is to be seen at a decision point.

A *decision point* is every K-th call of an episode, before the call is made. Where its monitor names another policy, control passes to that one: its
caller is reset, it knows nothing of what was seen before, and its first call waits on its own network as any call does. What is left of the old chunk
is dropped, or with a new driver of mode `async` made while the robot waits, as the loop does with a late answer.
"""

import copy
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError
from osel_sim.episodes.driver import Driver, Tally, episode_seed
from osel_sim.episodes.look import LiveLook
from osel_sim.interface.call import Call
from osel_sim.interface.encoder import Encoder, Image
from osel_sim.interface.environment import ActionSpec, Environment
from osel_sim.interface.instance import Instance
from osel_sim.interface.monitor import DecisionPoint, Monitor, Turn
from osel_sim.interface.outcome import Driving, Handoff, Monitored, Outcome, Seconds
from osel_sim.interface.policy import Actions, Observation
from osel_sim.policy.history import History
from osel_sim.selection.reward import total_seconds

type Course[T] = Generator[DecisionPoint, Turn, T]
"""An episode that stops at its decision points, and wants to be sent who drives on."""

Answer = tuple[Call, int]
"""A call, and how many actions of the old chunk were made while it was answered."""


class Fleet(Protocol):
    """Policies by name, ready to drive (`osel_sim.episodes.drivers.Drivers`)."""

    def __getitem__(self, name: str) -> Driver:
        """The policy of that name."""
        ...

    def fallback(self, name: str) -> Driver | None:
        """Who takes over when it cannot go on."""
        ...


@dataclass(frozen=True)
class Handoffs:
    """How control may pass from one policy to another within an episode.

    Attributes:
        drivers: of `policies` and their fallbacks.
        policies: names of those that may drive.
        monitor: decides.
        decide_every: a decision point is every so many calls, >= 1.
        horizon: control steps after which the episode ends.
        encoder: of the pictures; None: there are none.
        cut: told of each decision point before the monitor is, with a function that keeps the episode as it is there
            (`osel_sim.episodes.moment`). Only where the environment has snapshots.
    """

    drivers: Fleet
    policies: Sequence[str]
    monitor: Monitor
    decide_every: int
    horizon: int
    encoder: Encoder | None = None
    cut: Callable[[DecisionPoint, Callable[[], Any]], None] | None = None

    def __post_init__(self) -> None:
        if self.decide_every < 1:
            raise UsageError(f"decide_every must be at least 1, got {self.decide_every}")
        if self.horizon < 1:
            raise UsageError(f"a monitor needs a horizon of at least 1 control step, got {self.horizon}")


class Running(Protocol):
    """An episode that goes on (`osel_sim.episodes.loop.Episode`), as far as handing over needs it."""

    env: Environment
    instance: Instance
    policy: str
    repeat: int
    rest: Actions
    planner: int
    tallies: list[Tally]

    @property
    def seconds(self) -> Seconds:
        """So far."""
        ...

    @property
    def price(self) -> float:
        """Cents so far."""
        ...

    def take_over(self, driver: Driver) -> None:
        """From now on this one drives."""
        ...

    def begin(self, driver: Driver, chance: tuple[int, ...]) -> None:
        """Tell a policy that it is to act from now on."""
        ...

    def observe(self, driver: Driver) -> Observation:
        """What a policy sees now."""
        ...

    def answered(self, call: Call, driver: Driver, tally: Tally) -> int:
        """Count a call, and let the time pass that it took."""
        ...

    def tell(self, message: Callable[[Any], None]) -> None:
        """Tell all subscribers."""
        ...

    def keep(self, point: DecisionPoint) -> Any:
        """The episode as it is."""
        ...


class Watch:
    """What is kept of an episode for its decision points.

    Attributes:
        points: how many there were.
        calls: of those that drove.
        asked_tallies: of those that were asked for a second opinion.
    """

    def __init__(self, handoffs: Handoffs) -> None:
        self.handoffs = handoffs
        self.points = self.calls = 0
        self.asked_tallies: list[Tally] = []
        self._asked: dict[str, Answer] = {}
        self._made: list[Handoff] = []
        self._overlap: float | None = None
        self._state: NDArray[Any] | None = None
        self._image: Image | None = None
        self._point: DecisionPoint | None = None

    def twin(self) -> "Watch":
        """Another one, of an episode that goes on from the same point."""
        twin = copy.copy(self)
        twin.asked_tallies = [replace(tally) for tally in self.asked_tallies]
        twin._asked, twin._made = dict(self._asked), list(self._made)
        return twin

    def start(self, env: Environment) -> None:
        """The episode begins."""
        self._state = state_of(env)

    def called(self, overlap: float | None) -> None:
        """The driver was called, and its chunk differs so far from what was left of the one before."""
        self.calls += 1
        self._overlap = overlap

    @property
    def due(self) -> bool:
        """Whether the coming call is a decision point."""
        return self.calls > 0 and self.calls % self.handoffs.decide_every == 0

    def point(self, episode: Running) -> DecisionPoint:
        """The decision point at which the episode is now."""
        env, before = episode.env, self._state
        self._state, self._asked = state_of(env), {}
        look = LiveLook(env, episode.instance.instruction, self.handoffs.encoder, self._image, lambda policy: self._ask(episode, policy))
        self._point = DecisionPoint(
            call=self.calls,
            step=int(env.steps),
            seconds=float(total_seconds(**vars(episode.seconds))),
            price=episode.price,
            time_used=min(1.0, env.steps / self.handoffs.horizon),
            driver=episode.policy,
            instruction=episode.instance.instruction,
            overlap=self._overlap,
            moved=moved(before, self._state),
            look=look,
        )
        if self.handoffs.cut is not None:
            point, cut = self._point, self.handoffs.cut
            cut(point, lambda: episode.keep(point))
        return self._point

    def take(self, episode: Running, driver: Driver, turn: Turn) -> tuple[Driver, Answer | None]:
        """Do as the monitor says. Returns who drives on, with its answer where it has been asked already."""
        point = self._point
        if point is not None and isinstance(point.look, LiveLook):
            self.points += 1
            told = replace(point, look=point.look.told())
            episode.tell(lambda subscriber: subscriber.on_point(told, turn))
            self._image = point.look.image
        self._point = None
        if turn.policy == episode.policy or episode.env.done:  # it may be over, while somebody was asked
            return driver, None
        return self.hand_over(episode, turn)

    def hand_over(self, episode: Running, turn: Turn) -> tuple[Driver, Answer | None]:
        """Let another policy take over."""
        driver, answer = self.handoffs.drivers[turn.policy], self._asked.get(turn.policy)
        self._made.append(Handoff(int(episode.env.steps), self.calls, episode.policy, turn.policy, turn.why))
        episode.take_over(driver)
        self._overlap = None
        if answer is not None and answer[0].actions is not None:
            self.calls += 1
            return driver, answer
        episode.begin(driver, self._chance(episode, turn.policy))
        return driver, None

    def monitored(self, tallies: Sequence[Tally], steps: int) -> Monitored:
        """What came of it so far."""
        return monitored(self.points, self._made, tallies, self.asked_tallies, steps)

    def _ask(self, episode: Running, policy: str) -> float | None:
        """Ask another policy for a chunk, the robot waiting. Returns how far it differs from what is left of the driver's."""
        driver, tally, rest = self.handoffs.drivers[policy], Tally(self.handoffs.drivers[policy].spec, int(episode.env.steps)), episode.rest
        self.asked_tallies.append(tally)
        episode.begin(driver, self._chance(episode, policy))
        call = driver.caller.call(History(driver.spec.history).with_present(episode.observe(driver)))
        made = episode.answered(call, driver, tally)
        episode.rest = rest[made:]
        self._asked = {name: (earlier, late + made) for name, (earlier, late) in self._asked.items()} | {policy: (call, made)}
        return difference(rest, call.actions, episode.env.specification.action)

    def _chance(self, episode: Running, policy: str) -> tuple[int, ...]:
        """What fixes the chance of a policy that takes over, or is asked: another one each time."""
        return (*episode_seed(episode.instance.key, policy, episode.repeat), 3, len(self._made), len(self.asked_tallies))


def decided(course: Course[Outcome], handoffs: Handoffs | None) -> Outcome:
    """Let an episode go on to its end, its monitor saying at each decision point who drives on."""
    try:
        point = next(course)
        if handoffs is None:
            raise RuntimeError("an episode has a decision point and no monitor")
        while True:
            try:
                turn = handoffs.monitor.drives_on(point)
            except Exception as problem:
                if not (isinstance(point.look, LiveLook) and point.look.busy):
                    raise  # the monitor's own trouble
                point = course.throw(problem)
                continue
            turn.check(handoffs.policies)
            point = course.send(turn)
    except StopIteration as end:
        outcome: Outcome = end.value
        return outcome


def difference(one: Actions, other: Actions | None, action: ActionSpec) -> float | None:
    """How far two chunks (T, D) differ that plan the same moments: root mean square over the motions, in half ranges, as far as both reach.

    None where they have no moment in common, or one is missing.
    """
    if other is None:
        return None
    length = min(len(one), len(other))
    if not length or not action.motions:
        return None
    apart = (one[:length].astype(np.float64) - other[:length])[:, action.motions] / action.half_range[action.motions]
    return float(np.sqrt(np.mean(np.square(apart))))


def moved(before: NDArray[Any] | None, now: NDArray[Any] | None) -> float | None:
    """How far one state (S,) is from another: root mean square. None where there is none."""
    if before is None or now is None or not len(now):
        return None
    return float(np.sqrt(np.mean(np.square(now.astype(np.float64) - before))))


def state_of(env: Environment) -> NDArray[Any] | None:
    """The environment's state now, without images."""
    return np.array(env.observe((), 16)["observation.state"]) if env.specification.state else None


def monitored(points: int, handoffs: Sequence[Handoff], tallies: Sequence[Tally], asked: Sequence[Tally], steps: int) -> Monitored:
    """What a monitor made of an episode.

    Args:
        tallies: of those that drove, in order.
        asked: of those that were asked for a second opinion.
        steps: control steps of the episode.
    """
    ends = [*(tally.began for tally in tallies[1:]), steps]
    drove = [(tally, end - tally.began) for tally, end in zip(tallies, ends, strict=True)] + [(tally, 0) for tally in asked]
    by_policy: dict[str, Driving] = {}
    for tally, taken in drove:
        was = by_policy.get(tally.spec.name, Driving(0, 0, 0, 0.0))
        by_policy[tally.spec.name] = Driving(was.steps + taken, was.calls + tally.calls, was.actions + tally.actions, was.price + tally.price)
    remote_steps = sum(taken for tally, taken in drove if tally.spec.is_remote)
    calls, remote_calls = (sum(tally.calls for tally, _ in drove if tally.spec.is_remote or every) for every in (True, False))
    return Monitored(
        points,
        tuple(handoffs),
        duty_steps=remote_steps / steps if steps else 0.0,
        duty_calls=remote_calls / calls if calls else 0.0,
        by_policy=by_policy,
    )
