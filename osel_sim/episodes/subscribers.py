"""Subscribers of the episode loop that measure or pace it; the video has a file of its own."""

import time
from typing import override

from osel_sim.episodes.loop import Frame, Subscriber
from osel_sim.interface.call import Call
from osel_sim.interface.outcome import Outcome


class Timing(Subscriber):
    """What an episode really took on this machine. Goes into `timing.jsonl`, never into the journal.

    Attributes:
        calls: seconds of each call of a policy, in order.
        seconds: of the whole episode.
    """

    def __init__(self) -> None:
        self.calls: list[float] = []
        self.seconds = 0.0
        self._start = time.perf_counter()

    @override
    def on_start(self, frame: Frame) -> None:
        self._start = time.perf_counter()

    @override
    def on_call(self, policy: str, call: Call) -> None:
        self.calls.append(call.measured_seconds)

    @override
    def on_end(self, outcome: Outcome) -> None:
        self.seconds = time.perf_counter() - self._start


class RealTime(Subscriber):
    """Sleeps so that control steps happen at the control rate, waits included. A machine that cannot keep up simply runs late."""

    def __init__(self) -> None:
        self._start, self._hz = time.perf_counter(), 0.0

    @override
    def on_start(self, frame: Frame) -> None:
        self._hz = frame.env.specification.control_hz
        self._start = time.perf_counter() - frame.steps / self._hz

    @override
    def on_step(self, frame: Frame) -> None:
        time.sleep(max(0.0, self._start + frame.steps / self._hz - time.perf_counter()))
