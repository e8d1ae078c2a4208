"""The page of a live run, served on loopback while the run goes on: it is made anew as the journal grows, and shows the last film.

Whoever runs it is another process than the run, so that the run neither waits for a page nor knows of it.
"""

import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, override

from osel_sim.core.errors import OselError
from osel_sim.formats.journal import JOURNAL, read_journal
from osel_sim.reporting.page import Live, to_html, waiting_html
from osel_sim.reporting.run_page import VIDEOS, run_page

LOOK = 0.5
"""Seconds between looks at the folder."""
SHARE, LONGEST = 0.2, 8.0
"""Making pages takes that share of a core at most, but one is never older than so many seconds if there is a newer decision."""
REPLAYED = 2_000
"""Decisions that are replayed for the verdict of a page that the next decision outdates."""
LINGER = 3.0
"""Seconds that the last page is served for after the run, for browsers that still look at it."""
HOST = "127.0.0.1"
FILM, VERSION = "/film.mp4", "/version"


class _Server(ThreadingHTTPServer):
    """Says nothing of browsers that hang up: it shares the terminal with the run."""

    daemon_threads = True

    @override
    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class WatchedPage:
    """A run's page, and a server of it on a free port.

    Args:
        folder: of the run; it may have no decision yet.

    Attributes:
        url: where it is.
        html, version: the page as it is now, and how often it was made.
        film: the last one.
        asked: when a browser last asked for something, by the monotonic clock.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.html, self.version = b"", 0
        self.film: Path | None = None
        self.asked = 0.0
        self._seen, self._cost, self._made = 0, 0.0, 0.0
        self._server = _Server((HOST, 0), _handler(self))
        self.url = f"http://{HOST}:{self._server.server_port}/"

    def serve(self, stop: threading.Event) -> None:
        """Serve until `stop` is set and browsers had time for the last page."""
        self.html = waiting_html(self.folder, Live(self.version)).encode()
        threading.Thread(target=self._server.serve_forever, args=(LOOK,), daemon=True).start()
        try:
            while not stop.wait(LOOK):
                if time.monotonic() - self._made > min(self._cost / SHARE, LONGEST):
                    self.look()
            self._cost = 0.0
            self.look(over=True)
            if time.monotonic() - self.asked < LINGER:
                time.sleep(LINGER)
        finally:
            self._server.shutdown()
            self._server.server_close()

    def look(self, over: bool = False) -> None:
        """Make the page anew if there are more decisions, or for a last time.

        Args:
            over: the run is.
        """
        file = self.folder / JOURNAL
        size = file.stat().st_size if file.is_file() else 0
        if size == self._seen and not over:
            return
        start = time.thread_time()
        try:
            decisions = read_journal(file) if size else []
            if decisions:
                last = next((one for one in reversed(decisions) if self._film_of(one.index, one.policy).is_file()), None)
                film = None if last is None else self._film_of(last.index, last.policy)
                words = "" if last is None else f"Decision {last.index + 1}, {last.policy}: {last.instruction}"
                live = Live(self.version + 1, FILM if film else "", words, len(decisions), over)
                self.html, self.film, self.version = to_html(run_page(self.folder, budget=REPLAYED), live).encode(), film, self.version + 1
        except (OselError, OSError) as error:  # such as a run folder that is being changed by hand
            self.html, self.version = waiting_html(self.folder, Live(self.version + 1), str(error)).encode(), self.version + 1
        self._seen, self._made, self._cost = size, time.monotonic(), time.thread_time() - start

    def _film_of(self, index: int, policy: str) -> Path:
        return self.folder / VIDEOS / f"{index:05d}-{policy}.mp4"


def _handler(page: WatchedPage) -> type[BaseHTTPRequestHandler]:
    """Answers GET for the page, its version and the film, and nothing else."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            page.asked = time.monotonic()
            # A name that somebody else's page made resolve to this machine is not ours.
            if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):
                return self.send_error(HTTPStatus.FORBIDDEN)
            answers: dict[str, tuple[str, Callable[[], bytes]]] = {
                "/": ("text/html; charset=utf-8", lambda: page.html),
                VERSION: ("text/plain", lambda: str(page.version).encode()),
            }
            if page.film is not None:
                answers[FILM] = ("video/mp4", page.film.read_bytes)
            kind, content = answers.get(self.path.partition("?")[0], ("", bytes))
            if not kind:
                return self.send_error(HTTPStatus.NOT_FOUND)
            body = content()
            self.send_response(HTTPStatus.OK)
            for name, value in (("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store")):
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            pass

    return Handler
