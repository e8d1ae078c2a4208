"""The pool of worker processes: what it gives when workers die, and that they never outlive their parent."""

import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from pool_helpers import Dying, die, refuse, squares
from remote_helpers import alive
from run_helpers import children, wait_until

from osel_sim.core.errors import UnknownNameError, WorkerError
from osel_sim.core.processes import Lost, Result, run_jobs


def spelled(setup, words, workers=1):
    """All that comes of words as jobs: (word, letter, cause of loss)."""
    with closing(run_jobs(setup, words, workers, len)) as events:
        return [(event.job, event.value if isinstance(event, Result) else None, getattr(event, "cause", None)) for event in events]


def test_results_stream_in_the_order_of_their_job_whatever_the_number_of_workers():
    one, three = (list(run_jobs(squares, range(5), workers, lambda job: 2)) for workers in (1, 3))
    assert one == [Result(job, index, job ** (index + 1)) for job in range(5) for index in range(2)]
    assert sorted(three, key=lambda event: (event.job, event.index)) == one
    assert list(run_jobs(squares, [], 3)) == []


def test_what_a_worker_died_on_is_tried_once_more_and_goes_on_from_there(tmp_path):
    assert spelled(Dying(tmp_path, once=True), ["abCd", "efg"]) == [
        *(("abCd", letter, None) for letter in "abCd"),
        *(("efg", x, None) for x in "efg"),
    ]
    assert (tmp_path / "log").read_text().splitlines() == ["abCd 0", "abCd 2", "efg 0"], "results that are there are not made again"


def test_what_two_workers_died_on_is_lost_and_the_rest_goes_on(tmp_path):
    events = spelled(Dying(tmp_path), ["aBc", "de"])
    assert events == [("aBc", "a", None), ("aBc", None, "signal 9"), ("aBc", "c", None), ("de", "d", None), ("de", "e", None)]


def test_what_raises_is_lost_with_its_error(tmp_path):
    events = list(run_jobs(Dying(tmp_path), ["a!c", "d?f"], 1, len))
    values = [(event.job, event.value) for event in events if isinstance(event, Result)]
    assert values == [("a!c", "a"), ("a!c", "c"), ("d?f", "d"), ("d?f", "f")]
    unexpected, ours = (event for event in events if isinstance(event, Lost))
    assert (unexpected.index, unexpected.cause) == (1, "KeyError: 'a!c'")
    assert isinstance(unexpected.error, KeyError) and "pool_helpers.py" in unexpected.error.__notes__[0]
    assert isinstance(ours.error, UnknownNameError) and str(ours.error) == "unknown word 'd?f': known: world" and not hasattr(ours.error, "__notes__")
    assert (tmp_path / "log").read_text().splitlines() == ["a!c 0", "a!c 2", "d?f 0", "d?f 2"], "an error would only come again"


def test_a_job_that_gives_too_few_results_is_noticed():
    events = list(run_jobs(squares, [4], 1, lambda job: 3))
    assert [type(event) for event in events] == [Result, Result, Lost] and "shorter" in events[2].cause


def test_three_lossy_jobs_in_a_row_are_the_end(tmp_path):
    seen = []
    with pytest.raises(WorkerError, match=r"3 jobs in a row .* the last of them aE \(signal 9\)"):
        seen += run_jobs(Dying(tmp_path), ["aB", "ab", "aC", "aD", "aE", "ab"], 1, len)
    starts = (tmp_path / "log").read_text().splitlines()
    assert "ab 0" in starts and starts[-1] == "aE 1"


def test_an_error_of_the_first_setup_is_the_callers():
    with pytest.raises(UnknownNameError, match="did you mean 'thing'"):
        list(run_jobs(refuse, ["a"], 2))


def test_workers_that_never_start_are_the_end():
    with pytest.raises(WorkerError, match=r"die while they start, 3 times in a row \(exit code 3\)"):
        list(run_jobs(die, ["a"], 1))


@pytest.mark.parametrize(("workers", "bad_starts"), [(1, 2), (2, 100)])
def test_a_replacement_that_dies_while_it_starts_does_not_end_the_rest(tmp_path, workers, bad_starts):
    """One worker whose replacement starts at the third go; and two of which only the first ever starts, and never dies."""
    words = ["aBc", "def", "ghi"] if workers == 1 else ["abc", "def", "ghi"]
    events = spelled(Dying(tmp_path, once=True, bad_starts=bad_starts), words, workers)
    assert sorted(events) == sorted((word, letter, None) for word in words for letter in word)


SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from osel_sim.core.processes import run_jobs

class Own:
    def __call__(self):
        from pool_helpers import sleep_long
        sleep_long()

list(run_jobs(Own(), ["a", "b"], 2))
"""


def start_script(folder: Path, **more) -> subprocess.Popen:
    """A script without `if __name__ == "__main__"` whose two workers set up for ten minutes."""
    (folder / "script.py").write_text(SCRIPT)
    arguments = [sys.executable, str(folder / "script.py"), str(Path(__file__).parent)]
    return subprocess.Popen(arguments, env={**os.environ, "STARTED": str(folder / "started")}, stderr=subprocess.PIPE, text=True, **more)


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.2, None])
def test_workers_end_with_a_killed_parent_from_their_first_moment_and_without_a_word(tmp_path, delay):
    """Killed as soon as it has two workers, and a little later while they import; None: while both are at work."""
    process = start_script(tmp_path)
    assert wait_until(lambda: len(children(process)) == 2, 30)
    workers = children(process)
    if delay is None:
        assert wait_until(lambda: (tmp_path / "started").is_dir() and len(list((tmp_path / "started").iterdir())) == 2, 30)
    else:
        time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert wait_until(lambda: not any(map(alive, workers)), 10)
    assert process.stderr.read() == ""
    process.stderr.close()


def test_ctrl_c_ends_the_workers(tmp_path):
    heeding = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # what is started in the background may ignore it
    process = start_script(tmp_path, preexec_fn=heeding)
    assert wait_until(lambda: len(children(process)) == 2, 30)
    workers = children(process)
    process.send_signal(signal.SIGINT)
    complaints = process.communicate(timeout=30)[1]
    assert wait_until(lambda: not any(map(alive, workers)), 10)
    assert complaints.count("Traceback") == 1 and complaints.rstrip().endswith("KeyboardInterrupt"), "the parent's own"
