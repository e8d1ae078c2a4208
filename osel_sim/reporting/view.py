"""Shows a live run in the browser while it goes on: starts `python -m osel_sim.report FOLDER --watch` beside it."""

import logging
import subprocess
import sys
from typing import override

from osel_sim.episodes.run_subscribers import Run, RunSubscriber

logger = logging.getLogger(__name__)

ENDING = 20.0
"""Seconds that the process is given to show the end of the run."""


class View(RunSubscriber):
    """Starts the process when the run begins, says where the page is, and ends it with the run. It also ends when this process is killed."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    @override
    def on_start(self, run: Run) -> None:
        command = [sys.executable, "-m", "osel_sim.report", str(run.folder), "--watch", "--watch-stdin"]
        # A session of its own: Ctrl-C is for the run, which still finishes its decision.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
        line = self._process.stdout.readline().strip() if self._process.stdout is not None else ""
        logger.info("%s", line or "the run cannot be shown; what it writes is as ever")

    @override
    def close(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            process.wait(ENDING)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
