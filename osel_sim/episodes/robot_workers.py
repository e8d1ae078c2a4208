"""What a worker process does for robots of a live run: it looks at instances and plays episodes, and neither decides nor learns."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from osel_sim.core.processes import Work
from osel_sim.episodes.played import Played
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.instance import Instance
from osel_sim.interface.selector import Choice, Context
from osel_sim.interface.suite import Task

if TYPE_CHECKING:
    from osel_sim.episodes.run_subscribers import RunSubscriber


@dataclass(frozen=True)
class Equipment:
    """What a worker needs; the same for all.

    Attributes:
        policies: those that drive, and their fallbacks.
        encoder: as `load_encoder` takes it.
        action_noise: as `run_episode` takes it.
        subscribers: of which `watch` is asked for each episode; each worker has its own.
    """

    tasks: tuple[Task, ...]
    policies: tuple[PolicySpec, ...]
    encoder: str
    action_noise: float = 0.0
    subscribers: "Sequence[RunSubscriber]" = ()


@dataclass(frozen=True)
class Look:
    """Look at the instance of a decision: its result is a `Seen`."""

    index: int
    instance: Instance

    def __str__(self) -> str:
        return f"the context of decision {self.index}"


@dataclass(frozen=True)
class Seen:
    """The encoder's context of an instance, and how long it took to be had."""

    context: Context
    seconds: float = 0.0


@dataclass(frozen=True)
class Play:
    """Let the chosen policy act on the instance of a decision, and then `others`: its result is a `Played`."""

    index: int
    instance: Instance
    choice: Choice
    others: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"decision {self.index}"


def equipped(equipment: Equipment) -> Work[Look | Play, Seen | Played]:
    """Load encoder, policies and servers once; then do one job after the other."""
    from osel_sim.context.encoder import load_encoder
    from osel_sim.core.torch_settings import threads
    from osel_sim.episodes.drivers import Drivers
    from osel_sim.episodes.loop import run_episode
    from osel_sim.episodes.start import Start
    from osel_sim.episodes.subscribers import Timing
    from osel_sim.episodes.view import view
    from osel_sim.suites.open_tasks import OpenTasks
    from osel_sim.suites.registry import common_specification

    encoder, drivers = load_encoder(equipment.encoder), Drivers(equipment.policies, common_specification(equipment.tasks))
    envs = OpenTasks(equipment.tasks)

    def play(job: Play) -> Played:
        began = time.perf_counter()
        env = envs[job.instance.task]
        start = Start(env, job.instance)
        drivers.trust(job.choice.propensities)
        timings = {policy: Timing() for policy in (job.choice.policy, *job.others)}
        outcomes = {}
        for policy, timing in timings.items():
            start.again()
            chosen = policy == job.choice.policy
            watching = [one for subscriber in equipment.subscribers for one in subscriber.watch(job.index, policy, chosen)]
            driver, fallback = drivers[policy], drivers.fallback(policy)
            outcomes[policy] = run_episode(env, job.instance, driver, fallback, [timing, *watching], action_noise=equipment.action_noise)
        took = {policy: {"seconds": timing.seconds, "calls": timing.calls} for policy, timing in timings.items()}
        outcome = outcomes.pop(job.choice.policy)
        return Played(outcome, start.scene, outcomes, seconds=time.perf_counter() - began, took=took)

    def look(job: Look) -> Seen:
        began, env = time.perf_counter(), envs[job.instance.task]
        env.load(job.instance)
        context = encoder.encode(view(env, encoder), job.instance.instruction)
        return Seen(context, time.perf_counter() - began)

    def work(job: Look | Play, _: int) -> Iterator[Seen | Played]:
        with threads(1):  # as in a run of one process: the last bits of a matrix product depend on the number
            yield play(job) if isinstance(job, Play) else look(job)

    return work
