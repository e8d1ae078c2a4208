"""A policy server in a process of its own, on loopback, that never outlives the process that started it."""

import contextlib
import json
import os
import queue
import secrets
import subprocess
import sys
import tempfile
import threading
from typing import IO, Self

from osel_sim.core.errors import RemoteError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.environment import EnvironmentSpec
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.protocol import TOKEN_VARIABLE, Greeting

STOP_SECONDS = 8.0
ERROR_LINES = 5


class PolicyServerProcess:
    """Runs `python -m osel_sim.serve` for one policy file.

    The token is random and travels through the environment, since anybody may read a command line. The server watches its standard input: when this
    process dies, however it dies, the pipe ends and the server goes too.

    Args:
        spec: which policy.
        environment: what it will drive.
        timeout: real seconds for one answer, of the clients given out.
        start_timeout: real seconds for loading the weights.
    """

    def __init__(self, spec: PolicySpec, environment: EnvironmentSpec, timeout: float = 30.0, start_timeout: float = 120.0) -> None:
        self._environment = environment
        self._spec, self._timeout, self._start_timeout = spec, timeout, start_timeout
        self._process: subprocess.Popen[str] | None = None
        self._errors: IO[str] | None = None
        self.token = ""
        self.url = ""

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
        name, folder, environment = self._spec.file.stem, str(self._spec.file.parent), json.dumps(self._environment.to_dict())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "osel_sim.serve", name, "--port=0", "--policies-dir", folder, "--environment", environment, "--watch-stdin"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={**os.environ, TOKEN_VARIABLE: self.token},
            text=True,
            start_new_session=True,  # Ctrl-C is for the parent, which may still need answers to finish
        )
        try:
            self.url = self._wait_for_url(self._process)
        except BaseException:
            self.close()
            raise

    def start_client(self) -> RemoteClient:
        """Start the server if it does not run, and give a client for it, not yet connected.

        Raises:
            RemoteError: as `start`.
        """
        self.start()
        return RemoteClient(self.url, self._environment, self.token, self._timeout, Greeting.of(self._spec, self._environment))

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
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
        if self._errors is not None:
            self._errors.close()
            self._errors = None

    def _wait_for_url(self, process: subprocess.Popen[str]) -> str:
        """The first line of the server's output names its address."""
        lines: queue.Queue[str] = queue.Queue()
        output = process.stdout
        if output is None:
            raise RemoteError("the policy server has no output")
        threading.Thread(target=lambda: lines.put(output.readline()), daemon=True).start()
        try:
            line = lines.get(timeout=self._start_timeout)
        except queue.Empty:
            raise RemoteError(
                f"the policy server of {self._spec.name!r} was not ready within {self._start_timeout:g} s{self._last_lines()}"
            ) from None
        try:
            return str(json.loads(line)["url"])
        except (ValueError, KeyError, TypeError):
            raise RemoteError(f"the policy server of {self._spec.name!r} did not start{self._last_lines()}") from None

    def _last_lines(self) -> str:
        if self._errors is None:
            return ""
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)  # its last words may still be on their way
        self._errors.seek(0)
        lines = self._errors.read().splitlines()[-ERROR_LINES:]
        return ": " + " | ".join(line.strip() for line in lines) if lines else ""
