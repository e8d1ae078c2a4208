"""Worker processes that record episodes: each has its own simulator, policies and servers, and may die without taking the others' work along.

The parent hands out one instance at a time and gets its episodes back one by one. If a worker dies, the episode it was in becomes an error row, and a
new worker does the rest of that instance.
"""

import functools
import multiprocessing
import queue
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING

from osel_sim.core.errors import OselError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.formats.rollout_log import Row
from osel_sim.formats.task_file import TaskSpec
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.sim.instance import Instance, make_instance

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


Episode = tuple[str, int]
"""Policy and repeat."""


@dataclass(frozen=True)
class Plan:
    """What is to be recorded; the same for all workers.

    Attributes:
        policies: those recorded, in the order of rows.
        everyone: those and their fallbacks.
        seeds: of the instances of each task.
        levels: taken in turn, seed by seed.
        repeats: episodes of each policy on one in `repeat_every` instances of each level; on the others one.
        encoder: as `load_encoder` takes it.
        axes: axis -> level, where it differs from the instance's level.
        action_noise: as `run_episode` takes it.
    """

    tasks: tuple[TaskSpec, ...]
    policies: tuple[PolicySpec, ...]
    everyone: tuple[PolicySpec, ...]
    seeds: range
    levels: tuple[int, ...]
    split: str
    encoder: str
    repeats: int = 1
    repeat_every: int = 1
    axes: Mapping[str, int] = field(default_factory=dict)
    action_noise: float = 0.0

    @functools.cached_property
    def instances(self) -> dict[str, Instance]:
        """Key -> instance, in the order of rows: task by task, seed by seed."""
        drawn = (make_instance(task, seed, self.levels[seed % len(self.levels)], self.split, self.axes) for task in self.tasks for seed in self.seeds)
        return {instance.key: instance for instance in drawn}

    def episodes(self, instance: str) -> list[Episode]:
        """Those of the instance of this key, in the order of rows."""
        turn = self.instances[instance].seed // len(self.levels)  # of all levels once: counting seeds would repeat some levels and never others
        repeats = self.repeats if turn % self.repeat_every == 0 else 1
        return [(spec.name, repeat) for spec in self.policies for repeat in range(repeats)]


@dataclass
class Recorded:
    """One instance with the episodes asked for. `context` is None if the worker died before it was made."""

    instance: str
    rows: dict[Episode, Row] = field(default_factory=dict)
    context: "NDArray[np.float32] | None" = None


def record(plan: Plan, missing: Mapping[str, Sequence[Episode]], workers: int) -> Iterator[Recorded | None]:
    """Record these episodes, by instance, each instance yielded when all of its are there, in no particular order; None for every episode in between.

    Every instance gets its context as well, also one without episodes.

    Raises:
        OselError: a worker cannot start.
    """
    todo: queue.SimpleQueue[tuple[str, Sequence[Episode]]] = queue.SimpleQueue()
    results: queue.SimpleQueue[Recorded | Exception | None] = queue.SimpleQueue()
    for work in missing.items():
        todo.put(work)
    crew = [_Supervisor(plan, todo, results) for _ in range(min(workers, len(missing)))]
    left = len(missing)
    try:
        for supervisor in crew:
            supervisor.start()
        while left:
            result = results.get()
            if isinstance(result, Exception):
                raise result
            left -= result is not None
            yield result
    finally:
        for supervisor in crew:
            supervisor.stop()


class _Supervisor(threading.Thread):
    """Hands instances to a worker process of its own, and starts another when that dies."""

    def __init__(
        self, plan: Plan, todo: "queue.SimpleQueue[tuple[str, Sequence[Episode]]]", results: "queue.SimpleQueue[Recorded | Exception | None]"
    ) -> None:
        super().__init__(daemon=True)
        self._plan, self._todo, self._results = plan, todo, results
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._stopped = False

    def run(self) -> None:
        try:
            while not self._stopped:
                self._record(*self._todo.get_nowait())
        except queue.Empty:
            self.stop()
        except Exception as error:
            if not self._stopped:
                self._results.put(error)

    def stop(self) -> None:
        """End the worker at once; its servers notice and end as well."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def _record(self, instance: str, episodes: Sequence[Episode]) -> None:
        recorded, missing = Recorded(instance), list(episodes)
        while True:
            pipe = self._pipe or self._hire()
            try:
                pipe.send((instance, missing))
                recorded.context = pipe.recv()
                for episode in missing:
                    recorded.rows[episode] = pipe.recv()
                    self._results.put(None)
                break
            except (EOFError, OSError):
                if self._stopped:
                    return
                died = self._dismiss()
                missing = [episode for episode in episodes if episode not in recorded.rows]
                if missing:
                    policy, repeat = missing.pop(0)
                    recorded.rows[policy, repeat] = error_row(self._plan, instance, policy, repeat, f"the worker process died ({died})")
                    self._results.put(None)
                if not missing:
                    break
        self._results.put(recorded)

    def _hire(self) -> Connection:
        """Start a worker and wait until it is ready.

        Raises:
            OselError: it cannot start.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(self._plan, theirs), daemon=True)
        self._process.start()
        theirs.close()
        try:
            problem = self._pipe.recv()
        except EOFError:
            problem = f"a worker process died while it started ({self._dismiss()})"
        if problem is not None:
            raise OselError(problem)
        return self._pipe

    def _dismiss(self) -> str:
        """How the dead worker ended."""
        process, self._process, self._pipe = self._process, None, None
        if process is None:
            return "it was not there"
        process.join()
        code = process.exitcode or 0
        return f"signal {-code}" if code < 0 else f"exit code {code}"


def _work(plan: Plan, pipe: Connection) -> None:
    """A worker process: says that it is ready, then sends for every (instance, episodes) it gets the context and one row an episode."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends its workers
    import torch

    from osel_sim.context.encoder import load_encoder
    from osel_sim.episodes.drivers import Drivers
    from osel_sim.episodes.loop import run_episode
    from osel_sim.episodes.view import view
    from osel_sim.sim.task_envs import TaskEnvs

    torch.set_num_threads(1)  # workers share the cores, and results must not depend on how many there are
    try:
        encoder = load_encoder(plan.encoder)
        drivers = Drivers(plan.everyone)
    except OselError as error:
        pipe.send(str(error))
        return
    envs = TaskEnvs(plan.tasks, keep=2)  # work comes task by task
    pipe.send(None)
    with drivers:
        while True:
            try:
                key, episodes = pipe.recv()
            except (EOFError, OSError):
                return  # the parent is gone or has no more work
            instance = plan.instances[key]
            env = envs[instance.task]
            env.load(instance)
            start = env.snapshot()
            pipe.send(encoder.encode(view(env, encoder), instance.instruction))
            for policy, repeat in episodes:
                env.restore(start)
                outcome = run_episode(env, instance, drivers[policy], drivers.fallback(policy), repeat=repeat, action_noise=plan.action_noise)
                pipe.send(make_row(instance, policy, repeat, outcome))


def error_row(plan: Plan, instance: str, policy: str, repeat: int, error: str) -> Row:
    """A row that says why there is no outcome."""
    return make_row(plan.instances[instance], policy, repeat, Outcome(False, 0.0, 0, Seconds(), 0, 0, 0.0, error=error))


def make_row(instance: Instance, policy: str, repeat: int, outcome: Outcome) -> Row:
    """One episode as a row of the rollout log."""
    return Row(
        task=instance.task,
        instance=instance.key,
        seed=instance.seed,
        level=instance.level,
        split=instance.split,
        instruction=instance.instruction,
        phrasing=instance.phrasing,
        target=instance.target,
        container=instance.container,
        policy=policy,
        repeat=repeat,
        success=outcome.success,
        subgoals=outcome.subgoals,
        steps=outcome.steps,
        **vars(outcome.seconds),
        calls=outcome.calls,
        actions=outcome.actions,
        price=outcome.price,
        fallback=outcome.fallback,
        error=outcome.error,
        axes=instance.axes,
    )
