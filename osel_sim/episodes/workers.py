"""Recording episodes in worker processes: each has its own simulator, policies and servers, and may die without taking the others' work along.

A worker gets one instance at a time and gives back its context, then one row an episode. An episode whose worker died is tried once more; if that
worker dies as well, it becomes an error row, and a new worker does the rest of the instance.
"""

import functools
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from osel_sim.context.names import DEFAULT_ENCODER
from osel_sim.core.errors import WorkerError
from osel_sim.core.processes import Result, Work, run_jobs
from osel_sim.episodes.moments import Cuts, MomentRunner, Moments
from osel_sim.episodes.shard import Shard
from osel_sim.episodes.worker_imports import worker_imports
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.formats.rollout_log import Row
from osel_sim.interface.instance import Instance
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.interface.suite import Prepares, Task

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

WORKER_DIED = "the worker process died"
"""How the error of an episode begins that was lost with its worker, which says nothing of the policy."""

KEPT_OPEN = 2
"""Environments that a worker keeps at a time."""

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
        cuts: where episodes are cut, to let other policies go on from there; None: nowhere.
        shard: which of the instances are meant; None for all.
    """

    tasks: tuple[Task, ...]
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
    cuts: Cuts | None = None
    shard: Shard | None = None

    @functools.cached_property
    def instances(self) -> dict[str, Instance]:
        """Key -> instance, in the order of rows: task by task, seed by seed."""
        wanted = [(task, seed) for task in self.tasks for seed in self.seeds]
        drawn = (self._instance(task, seed) for task, seed in (wanted if self.shard is None else self.shard.part(wanted)))
        return {instance.key: instance for instance in drawn}

    @property
    def perturbed(self) -> list[str]:
        """Axes perturbed beyond an instance's level, as its `axes` says them; of a shard those of the whole: they depend on task and level alone."""
        one_of_each = (self._instance(task, seed) for task in self.tasks for seed in self.seeds[: len(self.levels)])
        return sorted({instance.axes for instance in [*self.instances.values(), *one_of_each] if instance.axes})

    def _instance(self, task: Task, seed: int) -> Instance:
        return task.instance(seed, self.levels[seed % len(self.levels)], self.split, self.axes)

    def episodes(self, instance: str) -> list[Episode]:
        """Those of the instance of this key, in the order of rows."""
        repeats = repeats_of(self.instances[instance].seed, len(self.levels), self.repeats, self.repeat_every)
        return [(spec.name, repeat) for spec in self.policies for repeat in range(repeats)]


def repeats_of(seed: int, levels: int, repeats: int, repeat_every: int) -> int:
    """Episodes of each policy on the instances of a seed; the rest as `Plan` has it, with the number of its levels."""
    turn = seed // levels  # of all levels once: counting seeds would repeat some levels and never others
    return repeats if turn % repeat_every == 0 else 1


@dataclass
class Recorded:
    """One instance with the episodes asked for. `context` is None if the worker died before it was made; without cuts there are no moments."""

    instance: str
    rows: dict[Episode, Row] = field(default_factory=dict)
    moments: dict[Episode, Moments] = field(default_factory=dict)
    context: "NDArray[np.float32] | None" = None


@dataclass(frozen=True)
class _Job:
    """One instance. Its results are the context, then a row an episode."""

    instance: str
    episodes: tuple[Episode, ...]

    def __str__(self) -> str:
        return self.instance


def record(
    plan: Plan, missing: Mapping[str, Sequence[Episode]], workers: int, begun: Callable[[], None] = lambda: None
) -> Generator[Recorded | None]:
    """Record these episodes, by instance, each instance yielded when all of its are there, in no particular order; None for every episode in between.

    Every instance gets its context as well, also one without episodes.

    Args:
        begun: called when all is loaded and the first episode begins.

    Raises:
        OselError: a policy or the encoder cannot be loaded.
        WorkerError: workers keep dying.
    """
    jobs = [_Job(instance, tuple(episodes)) for instance, episodes in missing.items()]
    under_way = {job.instance: Recorded(job.instance) for job in jobs}
    made, cause = 0, ""
    for suite in {id(task.suite): task.suite for task in plan.tasks}.values():
        if isinstance(suite, Prepares):
            suite.prepare()  # here, once, rather than in every worker
    imports = worker_imports(plan.tasks, torch=plan.encoder == DEFAULT_ENCODER)
    with closing(run_jobs(functools.partial(_recorder, plan), jobs, workers, lambda job: 1 + len(job.episodes), imports=imports)) as events:
        for number, event in enumerate(events):
            if number == 0:
                begun()
            job, recorded = event.job, under_way[event.job.instance]
            if event.index == 0:
                recorded.context = event.value if isinstance(event, Result) else None
            else:
                policy, repeat = job.episodes[event.index - 1]
                if isinstance(event, Result):
                    recorded.rows[policy, repeat], moments = event.value
                    recorded.moments |= {(policy, repeat): moments} if moments is not None else {}
                    made += 1
                else:
                    cause = event.cause
                    recorded.rows[policy, repeat] = error_row(plan, job.instance, policy, repeat, f"{WORKER_DIED} ({cause})")
                yield None
            if event.index == len(job.episodes):
                yield under_way.pop(job.instance)
    if cause and not made:
        raise WorkerError(f"no episode was recorded: {WORKER_DIED} every time ({cause})")


def _recorder(plan: Plan) -> Work[_Job, Any]:
    """What a worker does: load encoder, policies and servers, then instance by instance."""
    from osel_sim.context.encoder import load_encoder
    from osel_sim.episodes.drivers import Drivers
    from osel_sim.episodes.loop import run_episode
    from osel_sim.episodes.start import Start
    from osel_sim.episodes.view import view
    from osel_sim.suites.open_tasks import OpenTasks
    from osel_sim.suites.registry import common_specification

    encoder, drivers = load_encoder(plan.encoder), Drivers(plan.everyone, common_specification(plan.tasks))
    if "torch" in sys.modules:  # importing it takes longer than an episode, and not every encoder and policy needs it
        sys.modules["torch"].set_num_threads(1)  # workers share the cores, and results must not depend on how many there are
    envs = OpenTasks(plan.tasks, keep=KEPT_OPEN)  # work comes task by task, or some instances of each in turn

    horizons = {task.name: max(1, task.info.horizon) for task in plan.tasks}
    runner = None if plan.cuts is None else MomentRunner(drivers, [spec.name for spec in plan.policies], plan.cuts, encoder, plan.action_noise)

    def work(job: _Job, start: int) -> "Iterator[NDArray[np.float32] | tuple[Row, Moments | None]]":
        instance = plan.instances[job.instance]
        env = envs[instance.task]
        begin = Start(env, instance)
        if start == 0:
            yield encoder.encode(view(env, encoder), instance.instruction)
        for policy, repeat in job.episodes[max(0, start - 1) :]:
            begin.again()
            if runner is not None:
                outcome, moments = runner.run(env, instance, policy, horizons[instance.task], repeat)
                yield make_row(instance, policy, repeat, outcome, begin.scene), moments
                continue
            outcome = run_episode(env, instance, drivers[policy], drivers.fallback(policy), repeat=repeat, action_noise=plan.action_noise)
            yield make_row(instance, policy, repeat, outcome, begin.scene), None

    return work


def worker_died(row: Row) -> bool:
    """Whether there is no outcome because a worker died, so that the episode should be recorded again."""
    return row.error is not None and row.error.startswith(WORKER_DIED)


def error_row(plan: Plan, instance: str, policy: str, repeat: int, error: str) -> Row:
    """A row that says why there is no outcome."""
    return make_row(plan.instances[instance], policy, repeat, Outcome(False, 0.0, 0, Seconds(), 0, 0, 0.0, error=error))


def make_row(instance: Instance, policy: str, repeat: int, outcome: Outcome, scene: str | None = None) -> Row:
    """One episode as a row of the rollout log; `scene` as `Start` has it."""
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
        robot=instance.other_robot,
        fallback_steps=outcome.fallback_steps,
        scene=scene,
    )
