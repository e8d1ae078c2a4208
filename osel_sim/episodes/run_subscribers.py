"""Subscribers of a live run: they are told of its decisions, and bring subscribers of their own to its episodes."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, override

import numpy as np
from numpy.typing import NDArray

from osel_sim.episodes.loop import Subscriber
from osel_sim.episodes.subscribers import RealTime, Timing
from osel_sim.episodes.video import Video
from osel_sim.formats.journal import TIMING, Decision, Lines
from osel_sim.formats.policy_changes import PolicyChange
from osel_sim.formats.run_warnings import RunWarning

VIDEOS = "videos"


class Run(Protocol):
    """A live run, as its subscribers see it.

    Attributes:
        folder: where it is written.
    """

    folder: Path

    @property
    def policies(self) -> Sequence[str]:
        """Names of the policies that were ever chosen from."""
        ...

    @property
    def decisions(self) -> Sequence[Decision]:
        """All decisions so far, also those of the run's earlier processes."""
        ...

    @property
    def rewards(self) -> NDArray[np.float64]:
        """(decisions, policies) reward of every policy in every decision, NaN where there is none."""
        ...

    @property
    def warnings(self) -> Sequence[RunWarning]:
        """All warnings so far, also those of the run's earlier processes."""
        ...


class RunSubscriber:
    """Is told what happens in a live run; does nothing unless overridden. It must leave the run as it found it.

    An error of a subscriber ends the run; the decision at hand is made again when it is resumed.
    """

    def on_start(self, run: Run) -> None:
        """The run begins, or goes on after the decisions that its journal has."""

    def on_event(self, event: PolicyChange) -> None:
        """A policy has joined or left, before the decision that comes next (`osel_sim.formats.policy_changes`)."""

    def on_instance(self, index: int) -> None:
        """A decision begins: its instance is about to be loaded."""

    def on_choice(self, index: int, policy: str) -> None:
        """The selector has chosen; no episode has begun."""

    def watch(self, index: int, policy: str, chosen: bool) -> Sequence[Subscriber]:
        """Subscribers for the coming episode of a decision.

        Args:
            chosen: whether it is the selector's choice; others run for comparison.
        """
        return ()

    def on_elsewhere(self, index: int, took: Mapping[str, Any]) -> None:
        """The episodes of a decision ran in a worker process, where `watch` of most subscribers is not asked (`osel_sim.episodes.side_by_side`).

        Args:
            took: `seconds` of the decision, of them `context_and_choice`, and `episodes`, as `timing.jsonl` has them.
        """

    def on_decision(self, decision: Decision, rewards: Mapping[str, float | None]) -> None:
        """A decision is made; it goes into the journal next.

        Args:
            rewards: of every policy that ran, None where an episode ended in an error.
        """

    def on_lines(self, index: int, checksums: Mapping[str, str]) -> None:
        """The lines of a decision are about to be on disk, all but the journal's.

        Args:
            checksums: file -> that of its line (`osel_sim.formats.journal.line_digest`).
        """

    def on_warning(self, warning: RunWarning) -> None:
        """Something changed that nobody announced, such as a policy that succeeds less than it did. The decision that showed it is in the journal."""

    def on_end(self, run: Run) -> None:
        """The run is over or interrupted, and all of its files are written. Not told after an error."""

    def close(self) -> None:
        """Let go of files and of the terminal; always called, after an error too."""


class TimingFile(RunSubscriber):
    """Writes `timing.jsonl`: what decisions and their episodes really took on this machine, and checksums of the lines beside it."""

    def __init__(self) -> None:
        self._lines: Lines | None = None
        self._start = self._chosen = 0.0
        self._episodes: dict[str, Timing] = {}
        self._row: dict[str, Any] = {}
        self._elsewhere: Mapping[str, Any] = {}

    @override
    def on_start(self, run: Run) -> None:
        self._lines = Lines(run.folder / TIMING, keep=len(run.decisions), mend=True)

    @override
    def on_instance(self, index: int) -> None:
        self._start, self._episodes, self._elsewhere = time.perf_counter(), {}, {}

    @override
    def on_elsewhere(self, index: int, took: Mapping[str, Any]) -> None:
        self._elsewhere = took

    @override
    def on_choice(self, index: int, policy: str) -> None:
        self._chosen = time.perf_counter()

    @override
    def watch(self, index: int, policy: str, chosen: bool) -> Sequence[Subscriber]:
        name = policy if policy not in self._episodes else f"{policy} alone"  # once more, without the monitor
        self._episodes[name] = Timing()
        return [self._episodes[name]]

    @override
    def on_decision(self, decision: Decision, rewards: Mapping[str, float | None]) -> None:
        self._row = {
            "index": decision.index,
            "seconds": time.perf_counter() - self._start,
            "context_and_choice": self._chosen - self._start,
            "episodes": {policy: {"seconds": timing.seconds, "calls": timing.calls} for policy, timing in self._episodes.items()},
            **self._elsewhere,
        }

    @override
    def on_lines(self, index: int, checksums: Mapping[str, str]) -> None:
        if self._lines is not None:
            self._lines.append({**self._row, "checksums": dict(checksums)})

    @override
    def close(self) -> None:
        if self._lines is not None:
            self._lines.close()


class Films(RunSubscriber):
    """Films the chosen policy's episode of some decisions into `videos/`.

    Args:
        folder: of the run.
        indices: of the decisions.
        quality: of the rendering, `full` or `fast`.
    """

    def __init__(self, folder: Path, indices: frozenset[int], quality: str = "full") -> None:
        self._folder, self._indices, self._quality = folder / VIDEOS, indices, quality

    @override
    def watch(self, index: int, policy: str, chosen: bool) -> Sequence[Subscriber]:
        return [Video(self._folder / f"{index:05d}-{policy}.mp4", quality=self._quality)] if chosen and index in self._indices else []


class Paced(RunSubscriber):
    """Runs the chosen policies' episodes in real time."""

    @override
    def watch(self, index: int, policy: str, chosen: bool) -> Sequence[Subscriber]:
        return [RealTime()] if chosen else []
