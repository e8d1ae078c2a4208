"""The page that grows with a live run: over real sockets, of a folder that a run is writing."""

import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from report_helpers import made_run
from run_helpers import wait_until

from osel_sim.api.report import report
from osel_sim.core.errors import DataError
from osel_sim.formats.journal import read_journal
from osel_sim.report import main
from osel_sim.reporting import watch
from osel_sim.reporting.run_page import run_page

MADE = 12


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_run(tmp_path_factory.mktemp("watch") / "whole", decisions=MADE)


def beginning(whole: Path, folder: Path, decisions: int) -> Path:
    """The folder as the run left it after so many decisions, with a torn line and an outcome too many at the end, as while it writes."""
    folder.mkdir(exist_ok=True)
    for name, more in (("episodes.jsonl", b'{"index": '), ("counterfactual.jsonl", b"")):
        lines = (whole / name).read_bytes().splitlines(keepends=True)
        (folder / name).write_bytes(b"".join(lines[: decisions + (not more)]) + more)
    for name in ("run.json", "contexts.npz"):
        (folder / name).write_bytes((whole / name).read_bytes())
    return folder


@pytest.fixture
def served(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[watch.WatchedPage, threading.Event]]:
    """A page of a run that has made no decision, being served."""
    monkeypatch.setattr(watch, "LOOK", 0.05)
    monkeypatch.setattr(watch, "LONGEST", 0.1)
    monkeypatch.setattr(watch, "LINGER", 0.5)
    page, stop = watch.WatchedPage(beginning(whole, tmp_path / "run", 0)), threading.Event()
    thread = threading.Thread(target=page.serve, args=(stop,))
    thread.start()
    yield page, stop
    stop.set()
    thread.join(60)
    assert not thread.is_alive()


def get(page: watch.WatchedPage, path: str = "/", host: str | None = None) -> tuple[int, str]:
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port, timeout=60)
    connection.request("GET", path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    return answer.status, answer.read().decode("latin-1")


def test_the_page_grows_and_shows_the_last_film(served: tuple[watch.WatchedPage, threading.Event], whole: Path) -> None:
    page, stop = served
    assert "No decision is made yet" in get(page)[1] and get(page, "/film.mp4")[0] == 404
    beginning(whole, page.folder, 3)
    assert wait_until(lambda: get(page, "/version")[1] == "1", 60)
    assert "3 decisions so far" in get(page)[1]
    last = read_journal(page.folder / "episodes.jsonl")[-1]
    (page.folder / "videos").mkdir()
    (page.folder / "videos" / f"00002-{last.policy.replace('/', '')}.mp4").write_bytes(b"a film")
    beginning(whole, page.folder, 5)
    assert wait_until(lambda: get(page, "/version")[1] == "2", 60)
    text = get(page)[1]
    assert "5 decisions so far" in text and "Decision 3, " in text and 'data-version="2"' in text
    assert "connect-src 'self'" in text and '<video src="/film.mp4?2"' in text
    assert get(page, "/film.mp4?2") == (200, "a film")
    stop.set()
    assert wait_until(lambda: "The run is over: 5 decisions" in get(page)[1], 60)


def test_only_this_machine_is_answered_and_only_what_is_meant(served: tuple[watch.WatchedPage, threading.Event]) -> None:
    page, _ = served
    assert page.url.startswith("http://127.0.0.1:")
    assert get(page, "/run.json")[0] == get(page, "/../run.json")[0] == 404
    assert get(page, host="evil.example")[0] == 403
    page.folder.joinpath("episodes.jsonl").write_text("nonsense\n")
    assert wait_until(lambda: "line 1: not JSON" in get(page)[1], 60)  # told, and looked at again


def test_a_run_that_goes_on_is_reported_as_far_as_it_is(whole: Path, tmp_path: Path) -> None:
    folder = beginning(whole, tmp_path / "run", 4)
    assert report(folder, out=tmp_path / "page").page.is_file()
    assert run_page(folder).title.endswith("over 4 decisions")
    made = made_run(tmp_path / "behind", decisions=3)  # contexts are written some at a time
    for name in ("episodes.jsonl", "counterfactual.jsonl"):
        (made / name).write_bytes((whole / name).read_bytes())
    assert run_page(made).title.endswith("over 3 decisions")
    (made / "summary.json").write_text(json.dumps({"decisions": MADE}))  # but the contexts of a run that is over are all there, or lost
    with pytest.raises(DataError, match="has no context of 9 instances"):
        run_page(made)


def test_only_live_runs_are_watched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path), "--watch"]) == 2
    assert "--watch: " in capsys.readouterr().err
