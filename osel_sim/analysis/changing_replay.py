"""Replays of selectors over streams that change, in processes; the result does not depend on how many.

Each selector goes through every stream in three ways: `through` all of its changes with what it learned before; `afresh`, begun anew at a change; and
as one that `knew`: it had the policies and prices of after the change from the first decision on, so that it has learned them when the change comes.
"""

import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from osel_sim.analysis.engine import WARM, Setup
from osel_sim.analysis.log import Array, LoggedOutcomes, mean_over_repeats
from osel_sim.analysis.stream_changes import Span, Timeline
from osel_sim.analysis.streams import Streams, draw_streams
from osel_sim.analysis.warm_start import WarmStart, show
from osel_sim.core.errors import UsageError, WorkerError
from osel_sim.core.processes import Lost, Work, run_jobs
from osel_sim.core.torch_settings import threads_where_imported
from osel_sim.interface.selector import Selector, SelectorFactory
from osel_sim.selection.changing import changing
from osel_sim.selection.reward import combined, counted_time

Way = Literal["through", "afresh", "knew"]
WAYS: tuple[Way, ...] = ("through", "afresh", "knew")
NOBODY = -1
"""Stands in place of a column where a way of going through the stream makes no decision."""


@dataclass(frozen=True)
class ChangingLog:
    """A log whose streams change. N instances, P policies, R repeats, S seeds, T decisions.

    Attributes:
        log: complete instances only.
        setup: weights, and what selectors are told.
        gains: (N, P, R) reward without the price. charges: (N, P, R) what the price takes off it.
    """

    log: LoggedOutcomes
    setup: Setup
    timeline: Timeline
    streams: Streams
    seeds: tuple[int, ...]
    gains: Array
    charges: Array

    @classmethod
    def of(cls, log: LoggedOutcomes, setup: Setup, timeline: Timeline, seeds: Sequence[int]) -> "ChangingLog":
        """Draw the streams: the instances and repeats are those of a replay in which nothing changes."""
        weights = setup.weights
        rewards = log.rewards(weights)
        known = np.isfinite(rewards)
        score, time = getattr(log, weights.success), counted_time(weights, log.steps, log.seconds)
        gains = np.where(known, combined(weights, score, time, np.zeros_like(log.price)), np.nan)
        charges = weights.alpha_price * log.price if weights.alpha_price > 0.0 else np.zeros_like(log.price)
        streams = draw_streams(rewards, seeds, timeline.decisions)
        return cls(log, setup, timeline, streams, tuple(seeds), gains, np.where(known, charges, np.nan))

    @cached_property
    def policies(self) -> tuple[str, ...]:
        """Names."""
        return self.log.policies

    def rewards(self, seed: int, span: Span) -> Array:
        """Rewards (T, P) in the stream of one seed (its position), were everything as it is in a span from the first decision on."""
        order, repeats, columns = self.streams.order[seed][:, None], self.streams.repeats[seed], np.arange(len(self.policies))
        gains = self.gains[order, columns, repeats][:, span.source]
        return np.asarray(gains - span.factor * self.charges[order, columns, repeats], np.float64)

    def means(self, span: Span) -> Array:
        """Mean reward over the repeats, (N, P), as it is in a span."""
        return np.asarray(mean_over_repeats(self.gains)[:, span.source] - span.factor * mean_over_repeats(self.charges), np.float64)


@dataclass(frozen=True)
class Piece:
    """Part of one stream in which nothing changes: contexts (n, D), rewards (n, P), columns of the policies that may be chosen."""

    contexts: NDArray[np.float32]
    rewards: Array
    columns: NDArray[np.int64]


_Job = tuple[str, Way, int, int]
"""Which selector, which way, which span (of the way through all: 0), which seed (its position)."""


def replay_changing(
    material: ChangingLog,
    selectors: Sequence[str],
    workers: int = 1,
    progress: Callable[[int], Any] = lambda decisions: None,
    factories: Mapping[str, SelectorFactory] | None = None,
) -> dict[str, dict[Way, NDArray[np.int16]]]:
    """Selector -> way -> columns chosen, (S, T); `NOBODY` where that way makes no decision.

    Of the ways that begin at a change, or knew of it, what is kept is what they chose from the change on, up to the next.

    Args:
        workers: processes; with 1 it happens in this one.
        progress: called with a number of decisions made; with 0 when the first worker begins.
        factories: selector -> what makes it, where it is none of the registry's.

    Raises:
        UsageError: a selector is to start warm and there is nothing to show it, or its policies cannot come and go.
    """
    warm = [name for name in selectors if name.endswith(WARM)]
    if warm and material.setup.warm_start is None:
        raise UsageError(f"{', '.join(warm)}: there are no outcomes of other instances to start warm with")
    after = range(1, len(material.timeline.spans))
    jobs: list[_Job] = [
        (name, way, span, seed)
        for name in selectors
        for way, span in (("through", 0), *((way, span) for span in after for way in WAYS[1:]))
        for seed in range(len(material.seeds))
    ]
    shape = material.streams.order.shape
    found: dict[str, dict[Way, NDArray[np.int16]]] = {name: {way: np.full(shape, NOBODY, np.int16) for way in WAYS} for name in selectors}
    with closing(_run(material, factories or {}, jobs, workers, lambda: progress(0))) as results:
        for (name, way, number, seed), columns in results:
            span = material.timeline.spans[number]
            where = slice(None) if way == "through" else span.decisions
            found[name][way][seed, where] = columns[-(span.stop - span.start) :] if way == "knew" else columns
            progress(len(columns))
    return found


def total_decisions(timeline: Timeline, selectors: int, seeds: int) -> int:
    """How many decisions that makes."""
    after = timeline.spans[1:]
    return selectors * seeds * (timeline.decisions + sum(span.stop - span.start + span.stop for span in after))


def play(selector: Selector, pieces: Sequence[Piece], policies: Sequence[str]) -> NDArray[np.int16]:
    """Show one stream to one selector, made for the policies of its first piece, in order; columns chosen, (T,).

    Raises:
        UsageError: its policies are to come and go, and cannot.
    """
    from osel_sim.selection.ppo.compiled import FastPPO, supports
    from osel_sim.selection.ppo.sb3 import PPOSelector

    if isinstance(selector, PPOSelector) and supports(selector):
        return _play_fast(FastPPO(selector), selector.network_inputs(np.concatenate([piece.contexts for piece in pieces])), pieces)
    column = {policy: index for index, policy in enumerate(policies)}
    chosen: list[int] = []
    there = pieces[0].columns
    for piece in pieces:
        come, gone = _differences(there, piece.columns)
        able = changing(selector, bool(gone)) if come or gone else None
        for add in come if able else ():
            able.add_policy(policies[add])  # type: ignore[union-attr]
        for retire in gone if able else ():
            able.retire_policy(policies[retire])  # type: ignore[union-attr]
        there = piece.columns
        for context, rewards in zip(piece.contexts, piece.rewards, strict=True):
            choice = selector.select(context)
            chosen.append(column[choice.policy])
            selector.update(context, choice, float(rewards[chosen[-1]]))
    return np.array(chosen, np.int16)


def _play_fast(ppo: Any, inputs: NDArray[np.float32], pieces: Sequence[Piece]) -> NDArray[np.int16]:
    """The same of PPO, compiled: its output layer grows and shrinks as that of `PPOSelector` does."""
    order = pieces[0].columns.tolist()
    chosen, at = [], 0
    for piece in _joined(pieces):
        come, gone = _differences(np.array(order, np.int64), piece.columns)
        for add in come:
            ppo.change_outputs(np.concatenate([np.eye(len(order), dtype=np.float32), np.full((1, len(order)), 1.0 / len(order), np.float32)]))
            order.append(add)
        for retire in gone:
            ppo.change_outputs(np.delete(np.eye(len(order), dtype=np.float32), order.index(retire), axis=0))
            order.remove(retire)
        stop = at + len(piece.contexts)
        chosen.append(np.array(order, np.int16)[ppo.run(inputs[at:stop], piece.rewards[:, order])])
        at = stop
    return np.concatenate(chosen)


def _joined(pieces: Sequence[Piece]) -> list[Piece]:
    """The pieces, those put together between which no policy comes or goes: a training step may lie across them."""
    found: list[Piece] = []
    for piece in pieces:
        if found and np.array_equal(found[-1].columns, piece.columns):
            last = found.pop()
            contexts, rewards = np.concatenate([last.contexts, piece.contexts]), np.concatenate([last.rewards, piece.rewards])
            piece = Piece(contexts, rewards, last.columns)
        found.append(piece)
    return found


def _differences(before: NDArray[np.int64], after: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Columns that come and columns that go."""
    return np.setdiff1d(after, before).tolist(), np.setdiff1d(before, after).tolist()


def _pieces(material: ChangingLog, way: Way, number: int, seed: int) -> list[Piece]:
    spans = material.timeline.spans
    contexts = material.log.contexts[material.streams.order[seed]]
    contexts.flags.writeable = False
    if way == "through":
        parts = [(span, span.decisions) for span in spans]
    else:
        span = spans[number]
        parts = [(span, span.decisions if way == "afresh" else slice(0, span.stop))]
    return [Piece(contexts[where], material.rewards(seed, span)[where], span.columns) for span, where in parts]


def _replay_job(material: ChangingLog, factories: Mapping[str, SelectorFactory], job: _Job) -> tuple[_Job, NDArray[np.int16]]:
    from osel_sim.selection.registry import make_selector

    name, way, number, seed = job
    pieces, policies, setup = _pieces(material, way, number, seed), material.policies, material.setup
    columns, size = pieces[0].columns, material.log.contexts.shape[1]
    own, factory = [policies[column] for column in columns], factories.get(name)
    kind, random = name.removesuffix(WARM), material.seeds[seed]
    selector: Selector = factory(own, size, random) if factory else make_selector(kind, own, size, random, **setup.settings.get(name, {}))
    with threads_where_imported(1):  # by now a selector that needs torch has imported it
        if name.endswith(WARM) and setup.warm_start is not None:
            show(selector, WarmStart(setup.warm_start.contexts, setup.warm_start.rewards[:, columns]), own, random)
        return job, play(selector, pieces, policies)


def _run(
    material: ChangingLog, factories: Mapping[str, SelectorFactory], jobs: Sequence[_Job], workers: int, ready: Callable[[], None]
) -> Generator[tuple[_Job, NDArray[np.int16]]]:
    if workers == 1:
        ready()
        for job in jobs:
            with threadpool_limits(1):  # the last bits of numpy's matrix products depend on the number of threads
                result = _replay_job(material, factories, job)
            yield result
        return
    with closing(run_jobs(partial(_replayer, material, factories), jobs, workers, ready=ready)) as events:
        for event in events:
            if isinstance(event, Lost):
                raise event.error or WorkerError(f"a worker process of the replay died twice ({event.cause}; out of memory?); try --workers 1")
            yield event.value


def _replayer(material: ChangingLog, factories: Mapping[str, SelectorFactory]) -> Work[_Job, tuple[_Job, NDArray[np.int16]]]:
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    threadpool_limits(1)
    return lambda job, _: [_replay_job(material, factories, job)]
