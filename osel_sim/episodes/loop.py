"""One episode: a policy drives the robot through one instance, on a virtual clock of control steps.

The world does not wait for an answer. At a control rate of f Hz a call of d seconds takes ceil(f d) control steps, in which the robot

- holds still (`blocking`), then executes the first `execute` actions of the answer; or
- finishes the chunk it has (`async`): after `execute` actions the next call is sent, and until it is answered the rest of the old chunk is executed,
  then the robot holds still. Of the answer it skips as many actions as it made meanwhile, since both chunks planned them for the same moments.

A local policy that answers within one control step takes none: it computes while the step runs, as control loops do.

The loop knows what policies and environments are (`osel_sim.interface`) and nothing of simulators; videos, progress bars and timings are subscribers.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from osel_sim.core.errors import SuiteHostError
from osel_sim.episodes.driver import Driver as Driver
from osel_sim.episodes.driver import Tally, monitor_seed
from osel_sim.episodes.driver import episode_seed as episode_seed
from osel_sim.episodes.handoffs import Answer, Course, Handoffs, Watch, decided, difference
from osel_sim.interface.call import Call, Privileged
from osel_sim.interface.environment import ActionSpec, Environment, LooksAhead, TakesChunks
from osel_sim.interface.instance import Instance
from osel_sim.interface.monitor import DecisionPoint, Turn
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.interface.policy import Actions, Observation
from osel_sim.policy.history import History


@dataclass(frozen=True)
class Frame:
    """The world after one control step, as subscribers see it.

    Attributes:
        env: to render from; a subscriber must not step it.
        policy: who drives (the fallback's name once it took over).
        steps: control steps so far.
        waiting: the robot held still in this step, since no answer was there.
        price: cents so far.
    """

    env: Environment
    instance: Instance
    policy: str
    steps: int
    waiting: bool
    price: float


class Subscriber:
    """Is told what happens in an episode; does nothing unless overridden. It must leave the simulation as it found it."""

    def on_start(self, frame: Frame) -> None:
        """The instance is loaded, nothing has moved."""

    def on_call(self, policy: str, call: Call) -> None:
        """A policy was asked and answered (or failed to)."""

    def on_step(self, frame: Frame) -> None:
        """One control step was made. Overriding this costs an environment that takes chunks a message a step."""

    def on_point(self, point: DecisionPoint, turn: Turn) -> None:
        """A monitor has said who drives on; `point.look` is what it looked at (`osel_sim.interface.monitor.Told`)."""

    def on_end(self, outcome: Outcome) -> None:
        """The episode is over, also after an error."""


def delay_steps(call: Call, remote: bool, control_hz: float) -> int:
    """Control steps that pass before the answer is there."""
    steps = math.ceil(round(call.seconds * control_hz, 6))  # rounded: 0.3 s is 6 steps, not 7 for 6.000000000000001
    return steps if remote or steps > 1 else 0


def run_episode(
    env: Environment,
    instance: Instance,
    driver: Driver,
    fallback: Driver | None = None,
    subscribers: Sequence[Subscriber] = (),
    repeat: int = 0,
    action_noise: float = 0.0,
    handoffs: Handoffs | None = None,
) -> Outcome:
    """Let `driver` act until the task is done or the horizon is reached.

    A failed call (deadline, outage, an answer of a wrong form) hands over to `fallback` for the rest of the episode; without one it ends the episode
    as an error. So does any exception but a subscriber's or a monitor's, which passes through: a crash is never counted as a policy's failure.

    Args:
        env: holds `instance`, just loaded or restored.
        repeat: number of this episode among those of the same policy on the same instance.
        action_noise: standard deviation of Gaussian noise on the motions of every action a policy makes, as a share of half their range (1, where
            that is [-1, 1]), >= 0. Without it an episode differs from its repeat in the network's delays at most, and a local policy's not at all.
        handoffs: others that may take over at decision points; the fallback is then that of whoever drives when a call fails.

    Returns:
        the outcome. `calls` and `actions` are the driver's own (with `handoffs` those of all that the monitor let drive); `price` and `seconds`
        contain the fallback's, `fallback_steps` says how far it drove.
    """
    if handoffs is not None:
        handoffs.monitor.reset(instance.instruction, driver.spec.name, monitor_seed(instance.key, driver.spec.name, repeat))
    return decided(course(env, instance, driver, fallback, subscribers, repeat, action_noise, handoffs), handoffs)


def course(
    env: Environment,
    instance: Instance,
    driver: Driver,
    fallback: Driver | None = None,
    subscribers: Sequence[Subscriber] = (),
    repeat: int = 0,
    action_noise: float = 0.0,
    handoffs: Handoffs | None = None,
) -> Course[Outcome]:
    """The same, one decision point after the other: whoever goes through it says who drives on, the monitor is not asked."""
    noise = _Noise(action_noise, env.specification.action, (*episode_seed(instance.key, driver.spec.name, repeat), 1))
    episode = Episode(env, instance, subscribers, noise, repeat, handoffs)
    return episode.course(episode.drive(driver), fallback)


class _Noise:
    """What the arm makes of an action: the robot's own inaccuracy, which no policy sees coming. The gripper only opens and closes."""

    def __init__(self, deviation: float, spec: ActionSpec, seed: tuple[int, ...]) -> None:
        self._spec, self._motions, self._random = spec, spec.motions, np.random.default_rng(seed)
        self._deviation = deviation * spec.half_range[spec.motions] if deviation else None

    def __call__(self, action: Actions) -> Actions:
        if self._deviation is None:
            return action
        action = action.copy()
        action[self._motions] += self._deviation * self._random.standard_normal(len(self._motions))
        return self._spec.clip(action)


class Episode:
    """The running state of one episode."""

    def __init__(
        self,
        env: Environment,
        instance: Instance,
        subscribers: Sequence[Subscriber],
        noise: _Noise,
        repeat: int = 0,
        handoffs: Handoffs | None = None,
    ) -> None:
        self.env, self.instance, self.noise, self.repeat = env, instance, noise, repeat
        self.spec = env.specification
        self.show_to(subscribers)
        self.policy = ""
        self.tallies: list[Tally] = []  # one for each time that somebody took over, the fallback's last
        self.upload = self.inference = self.download = 0.0
        self.telling = False  # a subscriber has the word
        self.handed_over: int | None = None  # control steps when the fallback took over
        self.history = History(1)
        self.rest: Actions = np.empty((0, self.spec.action.dimension), np.float32)  # of the old chunk, still to be made while a call is answered
        self.planner = 0  # whose they are, as an index of the tallies
        self.watch = None if handoffs is None else Watch(handoffs)

    def show_to(self, subscribers: Sequence[Subscriber]) -> None:
        """Let these watch from now on."""
        self.subscribers = subscribers
        watched = any(type(subscriber).on_step is not Subscriber.on_step for subscriber in subscribers)
        self.chunked = self.env if isinstance(self.env, TakesChunks) and not watched else None

    def course(self, driving: Course[str | None], fallback: Driver | None) -> Course[Outcome]:
        """The episode to its end, whatever goes wrong in what `drive` or `drive_on` returned."""
        fallback_reason: str | None = None
        error: str | None = None
        try:
            failure = yield from driving
            if self.watch is not None:
                fallback = self.watch.handoffs.drivers.fallback(self.policy)
            if failure is not None and fallback is not None:
                fallback_reason, self.handed_over = failure, self.env.steps
                failure = yield from self.drive(fallback, decide=False)
            error = None if failure is None else f"{self.policy}: {failure}"
        except Exception as problem:
            if self.telling and not isinstance(problem, SuiteHostError):  # a simulator that ended may be noticed by a video first
                raise  # a subscriber's trouble (a full disk) is none of the policy's
            self.telling = False
            error = f"{self.policy}: {type(problem).__name__}: {' '.join(str(problem).split())}"
        outcome = self.outcome(fallback_reason, error)
        for subscriber in self.subscribers:
            subscriber.on_end(outcome)
        return outcome

    def drive(self, driver: Driver, decide: bool = True) -> Course[str | None]:
        """Let one policy act until the episode is over, or with `decide` those that take over from it. Returns why a call failed, or None."""
        self.take_over(driver)
        self.rest = self.rest[:0]
        self.begin(driver, episode_seed(self.instance.key, driver.spec.name, self.repeat))
        return (yield from self.drive_on(driver, decide))

    def drive_on(self, driver: Driver, decide: bool) -> Course[str | None]:
        """The same, of one that has taken over already."""
        while not self.env.done:
            answer: Answer | None = None
            if decide and self.watch is not None and self.watch.due:
                turn = yield self.watch.point(self)
                driver, answer = self.watch.take(self, driver, turn)
                if self.env.done:  # while somebody was asked
                    break
            if answer is None:
                call = driver.caller.call(self.history.with_present(self.observe(driver)))
                if self.watch is not None:
                    self.watch.called(difference(self.rest, call.actions, self.spec.action) if self.planner == len(self.tallies) - 1 else None)
                answer = call, self.answered(call, driver, self.tallies[-1])
            call, made = answer
            if call.actions is None:
                return call.failure
            self.tallies[-1].paid_per_action = call.paid_per_action  # only now: what was made while waiting is of the answer before
            stop = max(made, driver.spec.execute)
            self._make(call.actions[made:stop], then_look=True)
            self.rest, self.planner = call.actions[stop:], len(self.tallies) - 1
        return None

    def take_over(self, driver: Driver) -> None:
        """From now on this one drives."""
        self.policy = driver.spec.name
        self.tallies.append(Tally(driver.spec, int(self.env.steps)))
        self.history = History(driver.spec.history)
        if len(self.tallies) == 1:
            frame = self._frame(waiting=False)
            self.tell(lambda subscriber: subscriber.on_start(frame))
            if self.watch is not None:
                self.watch.start(self.env)

    def begin(self, driver: Driver, seed: tuple[int, ...]) -> None:
        """Tell a policy that it is to act from now on."""
        if isinstance(driver.caller, Privileged):
            driver.caller.bind(self.env)
        driver.caller.reset(self.instance.instruction, seed)

    def keep(self, point: DecisionPoint) -> "Moment":
        """The episode as it is, to go on from."""
        return Moment(point, self.env.snapshot(), self.twin())

    def twin(self) -> "Episode":
        """Another one at the same point, with the same environment."""
        twin = copy.copy(self)
        twin.tallies, twin.noise = [replace(tally) for tally in self.tallies], copy.deepcopy(self.noise)
        twin.watch = None if self.watch is None else self.watch.twin()
        return twin

    def outcome(self, fallback: str | None, error: str | None) -> Outcome:
        """What came of it, if it ends now."""
        own = self.tallies if self.handed_over is None else self.tallies[:-1]
        return Outcome(
            success=bool(self.env.success),
            subgoals=float(self.env.subgoal_fraction),
            steps=int(self.env.steps),
            seconds=self.seconds,
            calls=sum(tally.calls for tally in own),
            actions=sum(tally.actions for tally in own),
            price=self.price,
            fallback=fallback,
            error=error,
            fallback_steps=None if self.handed_over is None else int(self.env.steps) - self.handed_over,
            monitored=None if self.watch is None else self.watch.monitored(self.tallies, int(self.env.steps)),
        )

    @property
    def seconds(self) -> Seconds:
        """So far."""
        return Seconds(self.upload, self.inference, self.download, self.env.steps / self.spec.control_hz)

    @property
    def price(self) -> float:
        """Cents so far."""
        asked = self.watch.asked_tallies if self.watch is not None else []
        return sum((tally.price for tally in [*self.tallies, *asked]), 0.0)

    def answered(self, call: Call, driver: Driver, tally: Tally) -> int:
        """Count a call, and let the time pass that it took. Returns how many actions of the old chunk were made meanwhile."""
        tally.calls += call.sent
        tally.megabytes += call.megabytes
        tally.paid += call.paid
        self.upload += call.upload
        self.inference += call.inference
        self.download += call.download
        spec = driver.spec
        self.tell(lambda subscriber: subscriber.on_call(spec.name, call))
        finish_chunk = spec.remote is not None and spec.remote.mode == "async"
        return self._wait(delay_steps(call, spec.is_remote, self.spec.control_hz), self.rest if finish_chunk else self.rest[:0])

    def _wait(self, steps: int, rest: Actions) -> int:
        """Let `steps` control steps pass, making the actions of `rest` as far as they go. Returns how many of them were made."""
        made = self._make(rest[:steps], self.planner)
        self._hold(steps - made)
        return made

    def _make(self, actions: Actions, planner: int = -1, then_look: bool = False) -> int:
        """Make the actions (T, D) of a policy, an index of the tallies, until the episode is over. Returns how many were made."""
        unseen = len(actions) - (self.history.length - 1)
        if self.chunked is not None and unseen > 0 and not self.env.done:
            chunk, spec = np.stack([self.noise(action) for action in actions[:unseen]]), self.tallies[-1].spec
            if isinstance(self.chunked, LooksAhead) and (then_look or unseen < len(actions)):
                made = self.chunked.advance_and_look(chunk, spec.cameras, spec.image_size)
            else:
                made = self.chunked.advance_chunk(chunk)
            self.tallies[planner].made(made)
            return made if made < unseen or unseen == len(actions) else made + self._make(actions[unseen:], planner)
        for made, action in enumerate(actions):
            if self.env.done:
                return made
            self._remember(len(actions) - made)
            self.env.advance(self.noise(action))
            self.tallies[planner].made(1)
            self._stepped(waiting=False)
        return len(actions)

    def _hold(self, steps: int) -> None:
        """Hold still for so many control steps, or until the episode is over."""
        unseen = steps - (self.history.length - 1)
        if self.chunked is not None and unseen > 1 and not self.env.done:
            self.chunked.advance_chunk(np.stack([self.env.hold_action()] * unseen))
            steps -= unseen
        for left in range(steps, 0, -1):
            if self.env.done:
                return
            self._remember(left)
            self.env.advance(self.env.hold_action())
            self._stepped(waiting=True)

    def observe(self, driver: Driver) -> Observation:
        """What a policy sees now."""
        return self.env.observe(driver.spec.cameras, driver.spec.image_size)

    def _remember(self, left: int) -> None:
        """Keep what is to be seen now, where a call after the `left` control steps to come may ask for it."""
        if left < self.history.length:
            spec = self.tallies[-1].spec
            self.history.remember(self.env.observe(spec.cameras, spec.image_size))

    def _stepped(self, waiting: bool) -> None:
        frame = self._frame(waiting)
        self.tell(lambda subscriber: subscriber.on_step(frame))

    def tell(self, message: Callable[[Subscriber], None]) -> None:
        """Tell all subscribers; their trouble is their own."""
        self.telling = True
        for subscriber in self.subscribers:
            message(subscriber)
        self.telling = False

    def _frame(self, waiting: bool) -> Frame:
        return Frame(self.env, self.instance, self.policy, self.env.steps, waiting, self.price)


@dataclass(frozen=True, eq=False)
class Moment:
    """An episode as it was at a decision point: with any policy it goes on from there, any number of times (`osel_sim.episodes.moment.go_on`).

    Attributes:
        point: where it is; what is to be looked at there is to be looked at before the episode itself goes on.
        snapshot: of its environment.
        episode: none of its own, a copy.
    """

    point: DecisionPoint
    snapshot: Any
    episode: Episode
