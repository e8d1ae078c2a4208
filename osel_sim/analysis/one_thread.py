"""Jobs of a replay, here or in worker processes, each computed on one thread: the last bits of matrix products depend on the number of threads."""

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial

from threadpoolctl import threadpool_limits

from osel_sim.core.errors import WorkerError
from osel_sim.core.processes import Lost, Work, run_jobs
from osel_sim.core.torch_settings import threads, threads_where_imported


def played[Job, Result](
    play: Callable[[Job], Result], jobs: Sequence[Job], workers: int, ready: Callable[[], None] = lambda: None
) -> Generator[tuple[Job, Result]]:
    """What comes of each job, in the order in which they are done.

    Args:
        play: does one job; picklable. Where it imports torch itself, it also limits torch's threads (`threads_where_imported`) after that.
        workers: processes; with 1 it happens in this one.
        ready: called when the first worker is set up.

    Raises:
        WorkerError: a worker died twice on the same job.
    """
    if workers == 1:
        ready()
        for job in jobs:
            # Not around all jobs: what the caller makes of one in between is not part of it.
            with threadpool_limits(1), threads_where_imported(1):
                result = play(job)
            yield job, result
        return
    with closing(run_jobs(partial(_player, play), jobs, workers, ready=ready)) as events:
        for event in events:
            if isinstance(event, Lost):
                raise event.error or WorkerError(f"a worker process of the replay died twice ({event.cause}; out of memory?); try --workers 1")
            yield event.job, event.value


def _player[Job, Result](play: Callable[[Job], Result]) -> Work[Job, Result]:
    """What a worker does. What it loads later, such as torch, which takes seconds and not all need, heeds the environment."""
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    threadpool_limits(1)
    return lambda job, _: [play(job)]


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for matrix products, torch's too, which this imports."""
    with threadpool_limits(1), threads(1):
        yield
