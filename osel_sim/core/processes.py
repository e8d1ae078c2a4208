"""A supervised pool of worker processes: work goes on when a worker dies, and no worker outlives the process that started it.

Workers are fresh interpreters, or forked from one that only imports (a forked GL context or thread pool is a crash waiting to happen), on a socket of
their own. They are not `multiprocessing` processes, for two reasons. Those import the caller's main module and unpickle their work before any code of
ours runs, and for these seconds do not notice that their parent was killed; here the first thing there is is a thread that waits for the end of the
socket. And they only work in scripts that have `if __name__ == "__main__"`.
"""

import contextlib
import json
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

import cloudpickle  # type: ignore[import-untyped]

from osel_sim.core.errors import WorkerError
from osel_sim.core.fork_server import Forked, fork
from osel_sim.core.worker import Raised, Ready, Value

STARTS = 3
"""A worker that dies so many times in a row while it starts is not started again."""
LOSSES = 3
"""After so many jobs in a row that lost a result with their worker, the pool gives up."""
DYING = 5.0
"""Seconds that a worker whose connection has ended is given to end, before it is killed."""
_BOOT = "import json, sys; sys.path[:] = json.loads(sys.argv[2]); from osel_sim.core.worker import serve; serve(int(sys.argv[1]))"

type Work[J, R] = Callable[[J, int], Iterable[R]]
"""`work(job, start)` gives the results of a job from number `start` on, in order. `start` is above 0 when earlier ones have been received already."""
type Setup[J, R] = Callable[[], Work[J, R]]
"""Runs once in each worker: loads what all jobs need."""


@dataclass(frozen=True)
class Result[J, R]:
    """Result number `index` of a job."""

    job: J
    index: int
    value: R


@dataclass(frozen=True)
class Lost[J]:
    """Result number `index` of a job that there will not be: it raised `error`, or its worker died on it twice. The job's later ones follow.

    Attributes:
        cause: such as `signal 9` or `KeyError: 'x'`.
        error: what it raised; None where the worker died.
    """

    job: J
    index: int
    cause: str
    error: Exception | None = None


def run_jobs[J, R](
    setup: Setup[J, R],
    jobs: Sequence[J],
    workers: int,
    results: Callable[[J], int] = lambda job: 1,
    ready: Callable[[], None] = lambda: None,
    imports: Sequence[str] = (),
) -> Generator[Result[J, R] | Lost[J], None, None]:
    """Work on jobs in worker processes. What comes of them does not depend on how many there are, only the order does.

    A result whose worker died is tried once more, at once. Close the iterator to end all workers; they also end when this process does.

    Args:
        setup: picklable, as everything that goes to or comes from a worker; what `__main__` defines travels by value.
        workers: at most so many processes.
        results: how many results a job has.
        ready: called when the first worker is set up.
        imports: modules that setup and jobs need and that are long in coming. They are imported once for all workers, in a process from which these
            are forked: to import them must start no thread and draw nothing. Without them, each worker is a fresh interpreter.

    Yields:
        all results of all jobs, those of one job in order; `Lost` where there is none.

    Raises:
        Exception: `setup` raised it before any worker was ready.
        WorkerError: three jobs in a row lost a result, or no worker starts.
    """
    with closing(Pool[J, R](setup, min(workers, len(jobs)), ready, imports)) as pool:
        for job in jobs:
            pool.add(job, results(job))
        yield from pool.work()


@dataclass
class _Task[J]:
    """A job under way.

    Attributes:
        end: number of its results.
        next: the one to come.
        tried: a worker died on that one before.
        loss: why one was lost; empty if none was.
    """

    job: J
    end: int
    next: int = 0
    tried: bool = False
    loss: str = ""


class _Worker:
    """A place for a worker process. `connection` is None while there is none."""

    def __init__(self, imports: Sequence[str]) -> None:
        self.task: _Task[Any] | None = None
        self.ready, self.failed_starts = False, 0
        self.connection: Connection | None = None
        self._imports = imports
        self._process: subprocess.Popen[bytes] | Forked | None = None

    @property
    def startable(self) -> bool:
        return self.connection is None and self.failed_starts < STARTS

    def start(self, setup: bytes) -> None:
        """Start a process. It says when it is ready."""
        connection, theirs = Pipe()
        with theirs:
            # Either way in a session of its own: Ctrl-C is for this process, which ends its workers.
            if self._imports and sys.platform == "linux":  # elsewhere system libraries do not stand being forked
                self._process = fork(theirs.fileno(), self._imports)
            else:
                arguments = [sys.executable, "-c", _BOOT, str(theirs.fileno()), json.dumps([str(folder) for folder in sys.path])]
                self._process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True)
        self.connection, self.ready = connection, False
        self.send(setup)

    def send(self, message: bytes) -> None:
        """Send to a process that may have died meanwhile; its connection says so when it is listened to."""
        if self.connection is not None:
            with contextlib.suppress(OSError):
                self.connection.send_bytes(message)

    def stop(self, at_once: bool = True) -> str:
        """End the process, or let it end if not `at_once`, and say how it did. What it started notices, and ends as well."""
        process, connection = self._process, self.connection
        self._process = self.connection = None
        if connection is not None:
            connection.close()
        if process is None:
            return "not started"
        with contextlib.suppress(subprocess.TimeoutExpired):
            if not at_once:
                process.wait(DYING)
        process.kill()
        code = process.wait()
        return f"signal {-code}" if code < 0 else f"exit code {code}"


class Pool[J, R]:
    """Worker processes for jobs of which not all are known beforehand; `run_jobs` says the rest. Close it to end them.

    Args:
        setup, ready, imports: as `run_jobs` has them.
        workers: at most so many processes.
    """

    def __init__(self, setup: Setup[J, R], workers: int, ready: Callable[[], None] = lambda: None, imports: Sequence[str] = ()) -> None:
        self._ready = ready
        self._setup, self._todo, self._unfinished = cloudpickle.dumps(setup), deque[_Task[J]](), 0
        self._workers = [_Worker(imports) for _ in range(workers)]
        self._begun = False  # some worker was ready once
        self._losses = 0

    def add(self, job: J, results: int = 1) -> None:
        """Put a job at the end of those that wait for `work`."""
        self._todo.append(_Task(job, results))
        self._unfinished += 1

    def work(self) -> Iterator[Result[J, R] | Lost[J]]:
        """Work on all jobs, those too that are added after a result; yields and raises as `run_jobs` does."""
        while self._unfinished:
            self._staff()
            listening = [worker for worker in self._workers if worker.connection is not None]
            ready = wait([worker.connection for worker in listening if worker.connection is not None])
            for worker in listening:
                if worker.connection in ready:
                    yield from self._heed(worker, worker.connection)

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.stop()

    def _heed(self, worker: _Worker, connection: Any) -> Iterator[Result[J, R] | Lost[J]]:
        """Act on a message of a worker, or on its end."""
        try:
            message = connection.recv()
        except (EOFError, OSError):
            yield from self._replace(worker, worker.stop(at_once=False), None)
            return
        match message:
            case Ready():
                if not self._begun:
                    self._ready()
                worker.ready, worker.failed_starts, self._begun = True, 0, True
                self._staff()
            case Value(value) if worker.task is not None:
                task: _Task[J] = worker.task
                index = task.next
                task.next, task.tried = index + 1, False
                if task.next == task.end:
                    worker.task = None
                    self._staff()
                yield Result(task.job, index, value)
                self._count(task)
            case Raised(error):
                worker.stop()  # what it raised in the midst of may be in any state
                yield from self._replace(worker, f"{type(error).__name__}: {error}", error)

    def _replace(self, worker: _Worker, cause: str, error: Exception | None) -> Iterator[Lost[J]]:
        """Put back the work of a worker that has ended, to be tried again or given up."""
        task: _Task[J] | None = worker.task
        worker.task = None
        if task is None:
            if not worker.ready:
                self._count_failed_start(worker, cause, error)
            self._staff()
            return
        lost = Lost(task.job, task.next, cause, error) if error is not None or task.tried else None
        if lost is None:
            task.tried = True
        else:
            task.next, task.tried, task.loss = task.next + 1, False, cause
        if task.next < task.end:
            self._todo.appendleft(task)
        self._staff()
        if lost is not None:
            yield lost
            self._count(task)

    def _staff(self) -> None:
        """Give work to workers that have none, and start as many of those that are not there as what is left can use."""
        for worker in self._workers:
            if self._todo and worker.ready and worker.task is None and worker.connection is not None:
                worker.task = task = self._todo.popleft()
                worker.send(cloudpickle.dumps((task.job, task.next, task.end)))
        starting = sum(worker.connection is not None and not worker.ready for worker in self._workers)
        for worker in [worker for worker in self._workers if worker.startable][: max(0, len(self._todo) - starting)]:
            while worker.startable:
                try:
                    worker.start(self._setup)
                except OSError as error:  # no memory, or too many processes
                    self._count_failed_start(worker, str(error.strerror), error)

    def _count_failed_start(self, worker: _Worker, cause: str, error: Exception | None) -> None:
        """Give up on a worker that never starts, and on everything if there is no other."""
        if error is not None and not self._begun:
            raise error
        worker.failed_starts += 1
        if all(one.failed_starts >= STARTS for one in self._workers):
            raise WorkerError(f"worker processes die while they start, {STARTS} times in a row ({cause})") from error

    def _count(self, task: _Task[J]) -> None:
        """Count a job, if that was its last result; give up if too many in a row were lossy."""
        if task.next < task.end:
            return
        self._unfinished -= 1
        self._losses = self._losses + 1 if task.loss else 0
        if self._losses == LOSSES:
            raise WorkerError(f"{LOSSES} jobs in a row were lost with their worker processes, the last of them {task.job} ({task.loss})")
