"""What workers do in tests of the pool. Imports next to nothing, since every worker imports it."""

import itertools
import os
import signal
import sys
import time
from pathlib import Path

from osel_sim.core.errors import UnknownNameError


def first_time(folder, what):
    """Whether this is asked for the first time, by any process."""
    try:
        (Path(folder) / what).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def squares():
    """Two results a job."""
    return lambda job, start: [job, job * job][start:]


class Dying:
    """A job is a word; its results are (word, letter). Letters that are capitals kill the worker, `!` raises.

    Args:
        once: capitals kill only one worker each.
        bad_starts: how many of the workers after the first die while they start.
    """

    def __init__(self, folder, once=False, bad_starts=0):
        self.folder, self.once, self.bad_starts = str(folder), once, bad_starts

    def __call__(self):
        number = next(number for number in itertools.count() if first_time(self.folder, f"start {number}"))
        if 1 <= number <= self.bad_starts:
            os._exit(7)
        return self.work

    def work(self, word, start):
        with (Path(self.folder) / "log").open("a") as log:
            log.write(f"{word} {start}\n")
        for letter in word[start:]:
            if letter == "!":
                raise KeyError(word)
            if letter == "?":
                raise UnknownNameError("word", word, ["world"])
            if letter.isupper() and (not self.once or first_time(self.folder, letter)):
                os.kill(os.getpid(), signal.SIGKILL)
            yield letter


def refuse():
    raise UnknownNameError("thing", "thnig", ["thing"])


def die():
    os._exit(3)


def sleep_long():
    """Says that it is there, and sleeps."""
    Path(os.environ["STARTED"]).mkdir(exist_ok=True)
    (Path(os.environ["STARTED"]) / str(os.getpid())).touch()
    time.sleep(600)


def look_around():
    """What a worker's surroundings are: a variable, the folder, a module of the path, its command line and a random number; and it speaks."""

    def work(job, start):
        import numpy as np
        from only_here import NUMBER

        print(f"out {job}", flush=True)
        print(f"err {job}", file=sys.stderr, flush=True)
        return [(os.environ["SEEN"], os.getcwd(), NUMBER, sys.argv[1:], float(np.random.random()))]

    return work


def blas_threads():
    """Threads that numpy computes with."""

    def work(job, start):
        import numpy  # noqa: F401
        from threadpoolctl import threadpool_info

        return [max(pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas")]

    return work


def slow_squares():
    """Two results a job, after a little while each, with the process that started this one."""
    parent = os.getppid()

    def work(job, start):
        for value in [job, job * job][start:]:
            yield parent, value
            time.sleep(0.2)

    return work


def forked_from():
    """Threads of the process that started this one, and modules that were imported there."""
    found = len(os.listdir(f"/proc/{os.getppid()}/task")), set(sys.modules)
    return lambda job, start: [found]
