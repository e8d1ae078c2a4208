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
from pool_helpers import Dying, blas_threads, die, forked_from, look_around, refuse, slow_squares, squares
from remote_helpers import alive
from run_helpers import started, wait_until

from osel_sim.core.errors import UnknownNameError, WorkerError
from osel_sim.core.processes import Lost, Result, run_jobs
from osel_sim.episodes.worker_imports import worker_imports
from osel_sim.suites.registry import find_task


@pytest.fixture(params=["fresh", "forked"])
def imports(request):
    """Modules that make workers be forked from a process that has imported them; none for workers that are fresh interpreters."""
    return {"fresh": (), "forked": ("pool_helpers",)}[request.param]


def spelled(imports, setup, words, workers=1):
    """All that comes of words as jobs: (word, letter, cause of loss)."""
    with closing(run_jobs(setup, words, workers, len, imports=imports)) as events:
        return [(event.job, event.value if isinstance(event, Result) else None, getattr(event, "cause", None)) for event in events]


def test_results_stream_in_the_order_of_their_job_whatever_the_number_of_workers(imports):
    one, three = (list(run_jobs(squares, range(5), workers, lambda job: 2, imports=imports)) for workers in (1, 3))
    assert one == [Result(job, index, job ** (index + 1)) for job in range(5) for index in range(2)]
    assert sorted(three, key=lambda event: (event.job, event.index)) == one
    assert list(run_jobs(squares, [], 3, imports=imports)) == []


def test_what_a_worker_died_on_is_tried_once_more_and_goes_on_from_there(tmp_path, imports):
    assert spelled(imports, Dying(tmp_path, once=True), ["abCd", "efg"]) == [
        *(("abCd", letter, None) for letter in "abCd"),
        *(("efg", x, None) for x in "efg"),
    ]
    assert (tmp_path / "log").read_text().splitlines() == ["abCd 0", "abCd 2", "efg 0"], "results that are there are not made again"


def test_what_two_workers_died_on_is_lost_and_the_rest_goes_on(tmp_path, imports):
    events = spelled(imports, Dying(tmp_path), ["aBc", "de"])
    assert events == [("aBc", "a", None), ("aBc", None, "signal 9"), ("aBc", "c", None), ("de", "d", None), ("de", "e", None)]


def test_what_raises_is_lost_with_its_error(tmp_path, imports):
    events = list(run_jobs(Dying(tmp_path), ["a!c", "d?f"], 1, len, imports=imports))
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


def test_three_lossy_jobs_in_a_row_are_the_end(tmp_path, imports):
    seen = []
    with pytest.raises(WorkerError, match=r"3 jobs in a row .* the last of them aE \(signal 9\)"):
        seen += run_jobs(Dying(tmp_path), ["aB", "ab", "aC", "aD", "aE", "ab"], 1, len, imports=imports)
    starts = (tmp_path / "log").read_text().splitlines()
    assert "ab 0" in starts and starts[-1] == "aE 1"


def test_an_error_of_the_first_setup_is_the_callers(imports):
    with pytest.raises(UnknownNameError, match="did you mean 'thing'"):
        list(run_jobs(refuse, ["a"], 2, imports=imports))


def test_workers_that_never_start_are_the_end(imports):
    with pytest.raises(WorkerError, match=r"die while they start, 3 times in a row \(exit code 3\)"):
        list(run_jobs(die, ["a"], 1, imports=imports))


@pytest.mark.parametrize(("workers", "bad_starts"), [(1, 2), (2, 100)])
def test_a_replacement_that_dies_while_it_starts_does_not_end_the_rest(tmp_path, workers, bad_starts, imports):
    """One worker whose replacement starts at the third go; and two of which only the first ever starts, and never dies."""
    words = ["aBc", "def", "ghi"] if workers == 1 else ["abc", "def", "ghi"]
    events = spelled(imports, Dying(tmp_path, once=True, bad_starts=bad_starts), words, workers)
    assert sorted(events) == sorted((word, letter, None) for word in words for letter in word)


SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from osel_sim.core.processes import run_jobs

class Own:
    def __call__(self):
        from pool_helpers import sleep_long
        sleep_long()

list(run_jobs(Own(), ["a", "b"], 2, imports=sys.argv[2:]))
"""


def start_script(folder: Path, imports=(), **more) -> subprocess.Popen:
    """A script without `if __name__ == "__main__"` whose two workers set up for ten minutes."""
    (folder / "script.py").write_text(SCRIPT)
    arguments = [sys.executable, str(folder / "script.py"), str(Path(__file__).parent), *imports]
    return subprocess.Popen(arguments, env={**os.environ, "STARTED": str(folder / "started")}, stderr=subprocess.PIPE, text=True, **more)


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.2, None])
def test_workers_end_with_a_killed_parent_from_their_first_moment_and_without_a_word(tmp_path, delay, imports):
    """Killed as soon as it has two workers, or what forks them, and a little later while they import; None: while both are at work."""
    process = start_script(tmp_path, imports)
    assert wait_until(lambda: len(started(process)) == (3 if imports and delay is None else 1 if imports else 2), 30)
    workers = started(process)
    if delay is None:
        assert wait_until(lambda: (tmp_path / "started").is_dir() and len(list((tmp_path / "started").iterdir())) == 2, 30)
    else:
        time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert wait_until(lambda: not any(map(alive, workers)), 10)
    assert process.stderr.read() == ""
    process.stderr.close()


def test_ctrl_c_ends_the_workers(tmp_path, imports):
    heeding = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # what is started in the background may ignore it
    process = start_script(tmp_path, imports, preexec_fn=heeding)
    assert wait_until(lambda: len(started(process)) == (3 if imports else 2), 30)
    workers = started(process)
    process.send_signal(signal.SIGINT)
    complaints = process.communicate(timeout=30)[1]
    assert wait_until(lambda: not any(map(alive, workers)), 10)
    assert complaints.count("Traceback") == 1 and complaints.rstrip().endswith("KeyboardInterrupt"), "the parent's own"


def test_a_forked_worker_is_in_the_world_of_the_moment(tmp_path, monkeypatch, capfd):
    """Not in that of when what forks it was started: variables, folder, path and streams; and each with random numbers of its own."""
    seen = []
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "only_here.py").write_text(f"NUMBER = {number}")
        with monkeypatch.context() as patch:
            patch.setenv("SEEN", str(number))
            patch.chdir(folder)
            patch.syspath_prepend(str(folder))
            [event] = run_jobs(look_around, [number], 1, imports=["numpy"])
        *there, chance = event.value
        assert there == [str(number), str(folder), number, []]
        assert capfd.readouterr() == (f"out {number}\n", f"err {number}\n")
        seen.append(chance)
    assert seen[0] != seen[1]


def test_what_libraries_read_when_they_are_imported_is_heeded(monkeypatch):
    for threads in ("1", "2"):
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", threads)
        [event] = run_jobs(blas_threads, [0], 1, imports=["numpy"])
        assert event.value == min(int(threads), os.cpu_count() or 1)


def test_what_forks_workers_may_die_as_well(tmp_path):
    """What they do comes nevertheless, and the next one is forked by another."""
    with closing(run_jobs(slow_squares, [1, 2], 1, lambda job: 2, imports=["pool_helpers"])) as events:
        first = next(events)
        os.kill(first.value[0], signal.SIGKILL)
        values = [first.value[1], *(event.value[1] for event in events)]
    assert values == [1, 1, 2, 4]
    assert [event.value for event in run_jobs(squares, [3], 1, lambda job: 2, imports=["pool_helpers"])] == [3, 9]


def test_a_module_that_cannot_be_imported_beforehand_is_the_matter_of_who_needs_it(tmp_path, monkeypatch):
    (tmp_path / "ends_all.py").write_text("import os; os._exit(5)")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert [event.value for event in run_jobs(squares, [3], 1, lambda job: 2, imports=["no_such_module"])] == [3, 9]
    with pytest.raises(WorkerError, match="die while they start, 3 times in a row"):
        list(run_jobs(squares, [3], 1, lambda job: 2, imports=["ends_all"]))
    assert [event.value for event in run_jobs(squares, [3], 1, lambda job: 2, imports=["pool_helpers"])] == [3, 9]


def test_what_forks_the_workers_of_episodes_only_imports():
    """It has one thread, as forks have only one, and nothing that draws. Threads of BLAS end before a fork by themselves."""
    [event] = run_jobs(forked_from, [0], 1, imports=worker_imports([find_task("lift")], torch=True))
    threads, modules = event.value
    assert threads == 1 and {"torch", "numba", "osel_sim.sim.env"} <= modules and not modules & {"mujoco", "robosuite", "OpenGL"}
