"""A server in a process of its own, on loopback, that never outlives the process that started it: of a policy, or of another suite's simulator."""

import contextlib
import json
import os
import secrets
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from multiprocessing.connection import wait
from typing import IO, Self

from osel_sim.core.errors import RemoteError
from osel_sim.core.shown import TOKEN_VARIABLE

STOP_SECONDS = 8.0
ERROR_LINES = 5


class ServerProcess(ABC):
    """A process that serves on loopback.

    It says where it listens on a pipe of its own: standard output belongs to whatever is loaded into it, and is kept with its errors.

    The token is random and travels through the environment, since anybody may read a command line. The server watches its standard input: when this
    process dies, however it dies, the pipe ends and the server goes too.

    Args:
        what: it is, for messages.
        start_timeout: real seconds until it must be ready.
    """

    def __init__(self, what: str, start_timeout: float) -> None:
        self._what, self._start_timeout = what, start_timeout
        self._process: subprocess.Popen[str] | None = None
        self._errors: IO[str] | None = None
        self.token = ""
        self.url = ""

    @abstractmethod
    def command(self, ready: int) -> list[str]:
        """The command line that starts it.

        Args:
            ready: descriptor to which it writes `{"url": ...}` when it listens.
        """

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def running(self) -> bool:
        """Whether the process is there (it may hang nevertheless)."""
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self) -> int | None:
        """Process id of the server, None before `start`."""
        return None if self._process is None else self._process.pid

    def start(self) -> None:
        """Start the server and wait until it answers; nothing if it runs.

        Raises:
            RemoteError: with the last lines it wrote, if it ended or was not ready in time.
        """
        if self.running:
            return
        self.close()
        self.token = secrets.token_urlsafe(32)
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")  # noqa: SIM115 - closed in close()
        ours, theirs = os.pipe()
        try:
            with open(ours, "rb", buffering=0) as ready:
                with open(theirs, "wb"):
                    self._process = subprocess.Popen(
                        self.command(theirs),
                        stdin=subprocess.PIPE,
                        stdout=self._errors,
                        stderr=self._errors,
                        env={**os.environ, TOKEN_VARIABLE: self.token},
                        text=True,
                        start_new_session=True,  # Ctrl-C is for the parent, which may still need answers to finish
                        pass_fds=[theirs],
                    )
                self.url = self._wait_for_url(self._process, ready)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop the server: politely, then not. May be called twice."""
        process, self._process = self._process, None
        if process is not None:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()
        if self._errors is not None:
            self._errors.close()
            self._errors = None

    def _wait_for_url(self, process: subprocess.Popen[str], ready: IO[bytes]) -> str:
        """The line that the server writes when it listens names its address."""
        end, line = time.monotonic() + self._start_timeout, b""
        while not line.endswith(b"\n"):
            ended = process.poll() is not None  # asked first, so that what it wrote before its end is read
            if wait([ready.fileno()], 0.1):
                part = ready.read(4096)
                line += part
                ended = ended or not part
            elif not ended and time.monotonic() > end:
                raise RemoteError(f"{self._what} was not ready within {self._start_timeout:g} s{self._last_lines()}")
            if ended and not line.endswith(b"\n"):
                raise RemoteError(f"{self._what} did not start{self._last_lines()}")
        return str(json.loads(line)["url"])

    def _last_lines(self) -> str:
        if self._errors is None:
            return ""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)  # its last words may still be on their way
        self._errors.seek(0)
        lines = self._errors.read().splitlines()[-ERROR_LINES:]
        return ": " + " | ".join(line.strip() for line in lines) if lines else ""
