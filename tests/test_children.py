"""Workers of a pool whose parent is killed."""

import signal
import subprocess
import sys
import time
from pathlib import Path

from remote_helpers import alive

SCRIPT = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from osel_sim.core.processes import end_with_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), end_with_parent) as pool:
        first, second = pool.submit(os.getpid), pool.submit(time.sleep, 600)
        print(*pool._processes, first.result(), flush=True)
        second.result()
"""


def test_killed_parents_leave_no_workers(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    with subprocess.Popen([sys.executable, str(tmp_path / "script.py")], stdout=subprocess.PIPE, text=True) as process:
        workers = set(map(int, process.stdout.readline().split()))
        assert len(workers) == 2
        process.send_signal(signal.SIGKILL)
    end = time.monotonic() + 30
    while any(map(alive, workers)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(alive, workers))
