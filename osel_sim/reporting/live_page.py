"""Writes the page of a live run when that is over."""

from pathlib import Path
from typing import override

from osel_sim.core.errors import OselError
from osel_sim.core.files import write_bytes
from osel_sim.episodes.run_subscribers import Run, RunSubscriber
from osel_sim.reporting.page import FIGURES, write_page
from osel_sim.reporting.run_page import run_page


class LivePage(RunSubscriber):
    """Writes `report.html` with its figures and tables, and `curve.png`, into the run's folder, unless no decision was made.

    Attributes:
        file: the page, or None where there is none.
        verdict: what it says first, and why; empty where there is none.
        problem: why it could not be written, or None. The run itself is complete then; `python -m osel_sim.report` tries again.
    """

    def __init__(self) -> None:
        self.file: Path | None = None
        self.verdict = ""
        self.problem: OselError | None = None

    @override
    def on_end(self, run: Run) -> None:
        if not run.decisions:
            return
        try:
            page = run_page(run.folder)
            self.file = write_page(page, run.folder)
            self.verdict = " ".join([f"{page.verdict.headline}.", *page.verdict.sentences])
            write_bytes(run.folder / "curve.png", (run.folder / FIGURES / "curves.png").read_bytes())  # where one looks first
        except OselError as problem:
            self.problem = problem
