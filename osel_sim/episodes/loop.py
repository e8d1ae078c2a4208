"""One episode: a policy drives the robot through one instance, on a virtual clock of control steps.

The world does not wait for an answer. At a control rate of f Hz a call of d seconds takes ceil(f d) control steps, in which the robot

- holds still (`blocking`), then executes the first `execute` actions of the answer; or
- finishes the chunk it has (`async`): after `execute` actions the next call is sent, and until it is answered the rest of the old chunk is executed,
  then the robot holds still. Of the answer it skips as many actions as it made meanwhile, since both chunks planned them for the same moments.

A local policy that answers within one control step takes none: it computes while the step runs, as control loops do.

The loop knows what policies and environments are (`osel_sim.interface`) and nothing of simulators; videos, progress bars and timings are subscribers.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from osel_sim.core.errors import SuiteHostError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call, Caller, Privileged
from osel_sim.interface.environment import ActionSpec, Environment, TakesChunks
from osel_sim.interface.instance import Instance
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.interface.policy import Actions, Observation
from osel_sim.policy.history import History


@dataclass(frozen=True)
class Driver:
    """A policy ready to drive: its file and whom to ask."""

    spec: PolicySpec
    caller: Caller


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

    def on_end(self, outcome: Outcome) -> None:
        """The episode is over, also after an error."""


def episode_seed(instance_key: str, policy: str, repeat: int) -> tuple[int, ...]:
    """What fixes an episode's chance (network delays, noise on actions): the instance, the policy and the repeat, never the order of episodes."""
    return (*(int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") for text in (instance_key, policy)), repeat)


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
) -> Outcome:
    """Let `driver` act until the task is done or the horizon is reached.

    A failed call (deadline, outage, an answer of a wrong form) hands over to `fallback` for the rest of the episode; without one it ends the episode
    as an error. So does any exception but a subscriber's, which passes through: a crash is never counted as a policy's failure.

    Args:
        env: holds `instance`, just loaded or restored.
        repeat: number of this episode among those of the same policy on the same instance.
        action_noise: standard deviation of Gaussian noise on the motions of every action a policy makes, as a share of half their range (1, where
            that is [-1, 1]), >= 0. Without it an episode differs from its repeat in the network's delays at most, and a local policy's not at all.

    Returns:
        the outcome. `calls` and `actions` are the driver's own; `price` and `seconds` contain the fallback's, `fallback_steps` says how far it drove.
    """
    noise = _Noise(action_noise, env.specification.action, (*episode_seed(instance.key, driver.spec.name, repeat), 1))
    episode = _Episode(env, instance, subscribers, noise)
    fallback_reason: str | None = None
    error: str | None = None
    try:
        failure = episode.drive(driver, episode_seed(instance.key, driver.spec.name, repeat))
        if failure is not None and fallback is not None:
            fallback_reason, episode.handed_over = failure, env.steps
            failure = episode.drive(fallback, episode_seed(instance.key, fallback.spec.name, repeat))
        error = None if failure is None else f"{episode.policy}: {failure}"
    except Exception as problem:
        if episode.telling and not isinstance(problem, SuiteHostError):  # a simulator that ended may be noticed by a video first
            raise  # a subscriber's trouble (a full disk) is none of the policy's
        episode.telling = False
        error = f"{episode.policy}: {type(problem).__name__}: {' '.join(str(problem).split())}"
    outcome = episode.outcome(fallback_reason, error)
    for subscriber in subscribers:
        subscriber.on_end(outcome)
    return outcome


@dataclass
class _Tally:
    """What one driver has used up."""

    spec: PolicySpec
    calls: int = 0
    actions: int = 0
    megabytes: float = 0.0
    paid: float = 0.0  # what calls cost beyond the file's price
    paid_per_action: float = 0.0  # the same for an action of the last answer

    @property
    def price(self) -> float:
        return self.spec.price.of(self.actions, self.calls, self.megabytes) + self.paid

    def made(self, actions: int) -> None:
        self.actions += actions
        self.paid += actions * self.paid_per_action


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


class _Episode:
    """The running state of one episode."""

    def __init__(self, env: Environment, instance: Instance, subscribers: Sequence[Subscriber], noise: _Noise) -> None:
        self.env, self.instance, self.subscribers, self.noise = env, instance, subscribers, noise
        self.spec = env.specification
        watched = any(type(subscriber).on_step is not Subscriber.on_step for subscriber in subscribers)
        self.chunked = env if isinstance(env, TakesChunks) and not watched else None
        self.policy = ""
        self.tallies: list[_Tally] = []  # the driver's, then the fallback's
        self.upload = self.inference = self.download = 0.0
        self.telling = False  # a subscriber has the word
        self.handed_over: int | None = None  # control steps when the fallback took over
        self.history = History(1)

    def drive(self, driver: Driver, seed: tuple[int, ...]) -> str | None:
        """Let one policy act until the episode is over. Returns why a call of it failed, or None."""
        spec = driver.spec
        self.policy = spec.name
        self.tallies.append(_Tally(spec))
        self.history = History(spec.history)
        if len(self.tallies) == 1:
            frame = self._frame(waiting=False)
            self._tell(lambda subscriber: subscriber.on_start(frame))
        finish_chunk = spec.remote is not None and spec.remote.mode == "async"
        rest = np.empty((0, self.spec.action.dimension), np.float32)  # actions of the old chunk still to be made while a call is answered
        if isinstance(driver.caller, Privileged):
            driver.caller.bind(self.env)
        driver.caller.reset(self.instance.instruction, seed)
        while not self.env.done:
            call = driver.caller.call(self.history.with_present(self._observe()))
            self._count(call)
            made = self._wait(delay_steps(call, spec.is_remote, self.spec.control_hz), rest if finish_chunk else rest[:0])
            if call.actions is None:
                return call.failure
            self.tallies[-1].paid_per_action = call.paid_per_action  # only now: what was made while waiting is of the answer before
            stop = max(made, spec.execute)
            self._make(call.actions[made:stop])
            rest = call.actions[stop:]
        return None

    def outcome(self, fallback: str | None, error: str | None) -> Outcome:
        own = self.tallies[0] if self.tallies else None
        return Outcome(
            success=bool(self.env.success),
            subgoals=float(self.env.subgoal_fraction),
            steps=int(self.env.steps),
            seconds=Seconds(self.upload, self.inference, self.download, self.env.steps / self.spec.control_hz),
            calls=own.calls if own else 0,
            actions=own.actions if own else 0,
            price=sum((tally.price for tally in self.tallies), 0.0),
            fallback=fallback,
            error=error,
            fallback_steps=None if self.handed_over is None else int(self.env.steps) - self.handed_over,
        )

    def _count(self, call: Call) -> None:
        self.tallies[-1].calls += call.sent
        self.tallies[-1].megabytes += call.megabytes
        self.tallies[-1].paid += call.paid
        self.upload += call.upload
        self.inference += call.inference
        self.download += call.download
        self._tell(lambda subscriber: subscriber.on_call(self.policy, call))

    def _wait(self, steps: int, rest: Actions) -> int:
        """Let `steps` control steps pass, making the actions of `rest` as far as they go. Returns how many of them were made."""
        made = self._make(rest[:steps])
        self._hold(steps - made)
        return made

    def _make(self, actions: Actions) -> int:
        """Make the actions (T, D) of the policy until the episode is over. Returns how many were made."""
        unseen = len(actions) - (self.history.length - 1)
        if self.chunked is not None and unseen > 1 and not self.env.done:
            made = self.chunked.advance_chunk(np.stack([self.noise(action) for action in actions[:unseen]]))
            self.tallies[-1].made(made)
            return made if made < unseen or unseen == len(actions) else made + self._make(actions[unseen:])
        for made, action in enumerate(actions):
            if self.env.done:
                return made
            self._remember(len(actions) - made)
            self.env.advance(self.noise(action))
            self.tallies[-1].made(1)
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

    def _observe(self) -> Observation:
        """What the driver sees now."""
        return self.env.observe(self.tallies[-1].spec.cameras, self.tallies[-1].spec.image_size)

    def _remember(self, left: int) -> None:
        """Keep what is to be seen now, where a call after the `left` control steps to come may ask for it."""
        if left < self.history.length:
            self.history.remember(self._observe())

    def _stepped(self, waiting: bool) -> None:
        frame = self._frame(waiting)
        self._tell(lambda subscriber: subscriber.on_step(frame))

    def _tell(self, message: Callable[[Subscriber], None]) -> None:
        self.telling = True
        for subscriber in self.subscribers:
            message(subscriber)
        self.telling = False

    def _frame(self, waiting: bool) -> Frame:
        price = sum((tally.price for tally in self.tallies), 0.0)
        return Frame(self.env, self.instance, self.policy, self.env.steps, waiting, price)
