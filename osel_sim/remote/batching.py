"""Requests of several clients answered together: those that come while an answer is computed, and those within a few milliseconds."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from osel_sim.interface.policy import Observation
from osel_sim.policy.batched import act_together
from osel_sim.remote.session import Session

Answer = bytes | Exception


@dataclass(frozen=True)
class Batching:
    """How long a request may wait for others, in seconds, and how many are answered together at most."""

    seconds: float
    most: int


class Batches:
    """Answers requests together. For one event loop.

    Args:
        in_thread: runs a function in the thread of inference.
        clients: how many there are now: once all of them wait, no other request can come.
    """

    def __init__(self, batching: Batching, in_thread: Callable[..., Awaitable[list[Answer]]], clients: Callable[[], int]) -> None:
        self._batching, self._in_thread, self._clients = batching, in_thread, clients
        self._waiting: list[tuple[Session, bytes, asyncio.Future[bytes]]] = []
        self._more = asyncio.Event()
        self._work: asyncio.Task[None] | None = None

    async def answer(self, session: Session, frame: bytes) -> bytes:
        """The reply to one frame, as `Session.answer` gives it, and raises."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting.append((session, frame, future))
        self._more.set()
        if self._work is None or self._work.done():
            self._work = asyncio.create_task(self._until_none_waits())
        return await future

    async def _until_none_waits(self) -> None:
        while self._waiting:
            await self._gathered()
            batch, self._waiting = self._waiting[: self._batching.most], self._waiting[self._batching.most :]
            try:
                answers = await self._in_thread(answer_together, [(session, frame) for session, frame, _ in batch])
            except Exception as error:  # the server stops
                answers = [error for _ in batch]
            for (_, _, future), answer in zip(batch, answers, strict=True):
                if future.done():
                    continue  # its client has gone
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)

    async def _gathered(self) -> None:
        """Wait until all wait who could, or as long as a request may."""
        loop = asyncio.get_running_loop()
        end = loop.time() + self._batching.seconds
        while len(self._waiting) < min(self._batching.most, self._clients()) and loop.time() < end:
            self._more.clear()
            try:
                await asyncio.wait_for(self._more.wait(), end - loop.time())
            except TimeoutError:
                return


def answer_together(asked: Sequence[tuple[Session, bytes]]) -> list[Answer]:
    """The reply to each session's frame, or what is wrong with it; what one client sends spoils no other's answer."""
    start = time.perf_counter()
    replies: dict[int, Answer] = {}
    acting: dict[int, Observation] = {}
    for index, (session, frame) in enumerate(asked):
        found = session.read_safely(frame)
        if isinstance(found, dict):
            acting[index] = found
        else:
            replies[index] = found
    actions = act_together([asked[index][0].policy for index in acting], list(acting.values())) if acting else []
    seconds = time.perf_counter() - start
    replies |= {index: asked[index][0].reply_safely(answer, seconds) for index, answer in zip(acting, actions, strict=True)}
    return [replies[index] for index in range(len(asked))]
