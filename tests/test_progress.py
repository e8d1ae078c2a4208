"""Progress bars begin when work does, and what has to be compiled before is announced."""

import logging

import numba
import pytest

from osel_sim.core.compiling import announced
from osel_sim.core.processes import run_jobs
from osel_sim.core.progress import progress


def test_a_bar_is_shown_from_its_beginning_on(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(3, "thing") as bar:
        assert capsys.readouterr().err == ""
        bar.begin()
        assert "0/3" in capsys.readouterr().err
        bar.update(3)
    assert "3/3" in capsys.readouterr().err
    with progress(3, "thing"):
        pass
    assert capsys.readouterr().err == ""


def test_workers_tell_when_the_first_of_them_is_ready() -> None:
    told: list[str] = []
    for _ in run_jobs(lambda: lambda job, start: [job], [1, 2], 1, ready=lambda: told.append("ready")):
        told.append("result")
    assert told == ["ready", "result", "result"]


def test_compiling_is_announced_once_and_only_where_it_happens(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    @numba.njit
    def double(number: float) -> float:
        return 2 * number

    for _ in range(2):
        with announced("doubling"):
            assert (double(1.0), double(1)) == (2.0, 2)
    assert [record.message for record in caplog.records] == ["compiling doubling, once on this machine (up to a minute) ..."]
