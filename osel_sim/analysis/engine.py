"""Replays of selectors over streams of a log, in processes; the result does not depend on how many."""

import os
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.streams import Streams, draw_streams
from osel_sim.analysis.warm_start import WarmStart, show
from osel_sim.analysis.within_budget import Within
from osel_sim.core.errors import UsageError, WorkerError
from osel_sim.core.processes import Lost, Work, run_jobs
from osel_sim.core.torch_settings import threads, threads_where_imported
from osel_sim.formats.replay_result import Choices
from osel_sim.interface.selector import Selector, SelectorFactory
from osel_sim.selection.budget import Budget
from osel_sim.selection.reward import RewardWeights

WARM = ":warm"
"""Ending of the name of a selector that is shown all outcomes of other instances before its stream begins."""

SLOW_FIRST = ("ppo", "neural_linear", "auto:warm", "auto", "ppo_tuned", "vw_regcb", "vw_squarecb")
"""Selectors whose replays take longest are begun first, so that no worker is left with a long one at the end."""


@dataclass(frozen=True)
class Setup:
    """Under what a log is replayed.

    Attributes:
        weights: of the reward.
        settings: selector -> keyword arguments, where they are not to be the defaults.
        warm_start: of other instances than the log's; needed for selectors named `NAME:warm`.
        budget: that all selectors keep to; None: they may spend what they like.
    """

    weights: RewardWeights
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    warm_start: WarmStart | None = None
    budget: Budget | None = None


@dataclass(frozen=True)
class Part:
    """Selectors to replay on the streams of all seeds, under each setup.

    Attributes:
        log: complete instances only (`osel_sim.analysis.streams.complete_instances`).
        selectors: names, as `osel_sim.selection.registry.make_selector` takes them; `NAME:warm` for one that is shown the `warm_start` first.
        seeds: of the streams, and of the selectors.
        decisions: length of a stream; None: all instances.
    """

    log: LoggedOutcomes
    setups: Sequence[Setup]
    selectors: Sequence[str]
    seeds: Sequence[int]
    decisions: int | None = None

    @property
    def total(self) -> int:
        """How many decisions that makes."""
        return len(self.setups) * len(self.selectors) * len(self.seeds) * (len(self.log) if self.decisions is None else self.decisions)


@dataclass(frozen=True)
class _Material:
    """What workers need for a part: contexts float32 (N, D), seeds, policies, prices (N, P, R) if there are budgets, and of each setup its rewards
    (N, P, R) and its streams."""

    contexts: NDArray[np.float32]
    seeds: tuple[int, ...]
    policies: tuple[str, ...]
    setups: tuple[Setup, ...]
    rewards: tuple[NDArray[np.float64], ...]
    streams: tuple[Streams, ...]
    prices: NDArray[np.float64] | None = None


_Job = tuple[int, int, str, int]
"""Which part, which of its setups, which selector, which seed (its position)."""


def replay(
    log: LoggedOutcomes, setups: Sequence[Setup], selectors: Sequence[str], seeds: Sequence[int], decisions: int | None = None, workers: int = 1
) -> list[Choices]:
    """Replay one part, whose attributes these are: the choices under each of its setups. See `replay_parts`."""
    [choices] = replay_parts([Part(log, setups, selectors, seeds, decisions)], workers)
    return choices


def replay_parts(
    parts: Sequence[Part],
    workers: int = 1,
    progress: Callable[[int], Any] | None = None,
    factories: Mapping[str, SelectorFactory] | None = None,
) -> Generator[list[Choices]]:
    """Replay parts in turn, with one set of workers: while the end of one is waited for, the next is begun. Close the iterator to end them.

    Args:
        workers: processes; with 1 it happens in this one.
        progress: called with a number of decisions made; with 0 when the first worker begins.
        factories: selector -> what makes it, where it is none of the registry's.

    Yields:
        of each part, as soon as it is complete: the choices under each of its setups.

    Raises:
        UsageError: a selector is to start warm and there is nothing to show it, or a stream is to be longer than the log.
    """
    for part in parts:
        warm = [name for name in part.selectors if name.endswith(WARM)]
        if warm and any(setup.warm_start is None for setup in part.setups):
            raise UsageError(f"{', '.join(warm)}: there are no outcomes of other instances to start warm with")
    materials = [_material(part) for part in parts]
    return _collected(parts, materials, workers, progress or (lambda decisions: None), factories or {})


def _material(part: Part) -> _Material:
    tables = tuple(part.log.rewards(setup.weights) for setup in part.setups)
    streams = tuple(draw_streams(table, part.seeds, part.decisions) for table in tables)
    prices = part.log.price if any(setup.budget is not None for setup in part.setups) else None
    return _Material(part.log.contexts, tuple(part.seeds), part.log.policies, tuple(part.setups), tables, streams, prices)


def _collected(
    parts: Sequence[Part], materials: Sequence[_Material], workers: int, count: Callable[[int], Any], factories: Mapping[str, SelectorFactory]
) -> Generator[list[Choices]]:
    """Put what comes of the jobs together, part by part."""
    jobs: list[_Job] = [
        (number, at, name, seed)
        for number, part in enumerate(parts)
        for name in sorted(part.selectors, key=_slowness)
        for at in range(len(part.setups))
        for seed in range(len(part.seeds))
    ]
    chosen = [
        [{name: np.zeros(own.order.shape, np.int16) for name in part.selectors} for own in material.streams]
        for part, material in zip(parts, materials, strict=True)
    ]
    missing = Counter(number for number, *_ in jobs)
    with closing(_run(materials, factories, jobs, workers, lambda: count(0))) as results:
        for number, part in enumerate(parts):
            while missing[number]:
                (of, at, name, seed), columns = next(results)
                chosen[of][at][name][seed] = columns
                missing[of] -= 1
                count(len(columns))
            yield [
                Choices(part.log.keys, part.log.policies, own.order, own.repeats, names)
                for own, names in zip(materials[number].streams, chosen[number], strict=True)
            ]


def replay_one(
    name: str,
    contexts: NDArray[np.float32],
    rewards: NDArray[np.float64],
    policies: Sequence[str],
    seed: int,
    warm_start: WarmStart | None = None,
    factory: SelectorFactory | None = None,
    within: Within | None = None,
    **settings: Any,
) -> NDArray[np.int16]:
    """Show one stream to one selector, which sees the reward of its choices only.

    Args:
        contexts: (T, D). rewards: (T, P).
        warm_start: shown first, in an order of the seed's.
        factory: makes the selector; None: the registry does.
        within: a budget to keep to.
        settings: of the selector.

    Returns:
        columns chosen, (T,); -1 from where a budget pays for nothing.
    """
    from osel_sim.selection.registry import make_selector

    size = contexts.shape[1]
    selector = make_selector(name, policies, size, seed, **settings) if factory is None else factory(policies, size, seed)
    with threads_where_imported(1):  # by now a selector that needs torch has imported it; the others do without, as that takes seconds
        if warm_start is not None:
            show(selector, warm_start, policies, seed)
        if within is not None:
            return within.play(selector, contexts, rewards, seed)
        return _played(selector, contexts, rewards, policies)


def _played(selector: Selector, contexts: NDArray[np.float32], rewards: NDArray[np.float64], policies: Sequence[str]) -> NDArray[np.int16]:
    """Columns chosen, (T,): by SB3's PPO all at once where that comes to the same, else decision by decision."""
    from osel_sim.selection.ppo.sb3 import PPOSelector

    if isinstance(selector, PPOSelector):
        from osel_sim.selection.ppo.compiled import FastPPO, supports

        if supports(selector):
            return FastPPO(selector).run(selector.network_inputs(contexts), rewards)
    column = {policy: index for index, policy in enumerate(policies)}
    chosen = np.zeros(len(contexts), np.int16)
    for decision, context in enumerate(contexts):
        choice = selector.select(context)
        chosen[decision] = column[choice.policy]
        selector.update(context, choice, float(rewards[decision, chosen[decision]]))
    return chosen


def _slowness(name: str) -> int:
    return SLOW_FIRST.index(name) if name in SLOW_FIRST else len(SLOW_FIRST)


def _run(
    materials: Sequence[_Material], factories: Mapping[str, SelectorFactory], jobs: Sequence[_Job], workers: int, ready: Callable[[], None]
) -> Generator[tuple[_Job, NDArray[np.int16]]]:
    if workers == 1:
        ready()
        for job in jobs:
            # The last bits of numpy's matrix products depend on the number of threads. Not around all jobs: what is made of a part in between is not
            # part of it.
            with threadpool_limits(1):
                result = _replay_job(materials, factories, job)
            yield result
        return
    with closing(run_jobs(partial(_replayer, materials, factories), jobs, workers, ready=ready)) as events:
        for event in events:
            if isinstance(event, Lost):
                raise event.error or WorkerError(f"a worker process of the replay died twice ({event.cause}; out of memory?); try --workers 1")
            yield event.value


def one_thread_worker() -> None:
    """Compute on one thread in this worker from now on."""
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    threadpool_limits(1)


def _replayer(materials: Sequence[_Material], factories: Mapping[str, SelectorFactory]) -> Work[_Job, tuple[_Job, NDArray[np.int16]]]:
    """What a worker does. What it loads later, such as torch, which takes seconds and not all need, heeds the environment."""
    one_thread_worker()
    return lambda job, _: [_replay_job(materials, factories, job)]


def _replay_job(materials: Sequence[_Material], factories: Mapping[str, SelectorFactory], job: _Job) -> tuple[_Job, NDArray[np.int16]]:
    part, at, name, number = job
    material = materials[part]
    setup, streams = material.setups[at], material.streams[at]
    rewards = streams.rewards(material.rewards[at], number)
    contexts = material.contexts[streams.order[number]]
    contexts.flags.writeable = False
    kind, shown = name.removesuffix(WARM), setup.warm_start if name.endswith(WARM) else None
    seed, factory = material.seeds[number], factories.get(name)
    within = None
    if setup.budget is not None and material.prices is not None:
        within = Within(setup.budget, streams.rewards(material.prices, number))
    return job, replay_one(kind, contexts, rewards, material.policies, seed, shown, factory, within, **setup.settings.get(name, {}))


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for matrix products, torch's too, which this imports: their last bits depend on the number, and workers share the cores anyway."""
    with threadpool_limits(1), threads(1):
        yield
