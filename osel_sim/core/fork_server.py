"""Worker processes forked from one that has imported already what they need: they start sooner, and what is imported is in memory once.

That process, the fork server (`osel_sim.core.forked`), only imports and forks. It draws nothing, computes nothing and has no thread, so what it forks
is as good as a fresh interpreter. `multiprocessing` has such a server too, but what that one forks first runs the caller's main module, and has the
environment and the standard streams of when the server started.
"""

import atexit
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection

from osel_sim.core.forked import Request

_BOOT = "import json, sys; sys.path[:] = json.loads(sys.argv[2]); from osel_sim.core.forked import serve_forks; serve_forks(int(sys.argv[1]))"
_READ_AT_IMPORT = ("BLIS_", "GOMP_", "KMP_", "MKL_", "NPY_", "NUMBA_", "OMP_", "OPENBLAS_", "OPENCV_", "VECLIB_")
"""How variables begin that numpy, numba and OpenCV read when they are imported: for other values of them there is another server."""


class Forked:
    """A process that the server forked; the part of `subprocess.Popen` that its owner needs.

    Args:
        status: from which its id comes, and then its exit code.
    """

    def __init__(self, status: int) -> None:
        self._status = Connection(status, writable=False)
        self._pid: int | None = None
        self._code: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """Exit code, below 0 for a signal.

        Raises:
            TimeoutExpired: it runs on.
        """
        self._know_pid()
        if self._code is None:
            if not self._status.poll(timeout):
                raise subprocess.TimeoutExpired("worker", timeout or 0.0)
            self._code = self._told()
            if self._code is None:  # the server was killed, and nobody tells
                self.kill()
                self._code = -signal.SIGKILL
        return self._code

    def kill(self) -> None:
        """Kill it, unless it has ended."""
        self._know_pid()
        if self._pid is None or self._code is not None:
            return
        if self._status.poll(0.0):  # it has ended, and its id may be another's by now; or the server has
            self._code = self._told()
        if self._code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)

    def _know_pid(self) -> None:
        if self._pid is None and self._code is None:
            self._pid = self._told()

    def _told(self) -> int | None:
        try:
            return int(self._status.recv())
        except (EOFError, OSError):
            return None


class ForkServer:
    """The server, started with the first process that is asked of it.

    Args:
        environment: what of the environment it depends on.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment
        ours, theirs = socket.socketpair()
        self._socket, self._connection = ours, Connection(os.dup(ours.fileno()))
        arguments = [sys.executable, "-c", _BOOT, str(theirs.fileno()), json.dumps(list(map(str, sys.path)))]
        with theirs:
            # Nothing is to be read from it: what it imports may say is said again by the processes that it forks, which have the streams of here.
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )

    @property
    def usable(self) -> bool:
        """Whether it can be asked: it runs, and imports under the variables there are now."""
        return self.environment == _read_at_import() and self._process.poll() is None

    def fork(self, descriptor: int, imports: Sequence[str]) -> Forked:
        """A process that serves (`osel_sim.core.worker.serve`) on a descriptor, here and now: with this environment, folder, path and streams.

        Raises:
            OSError: the server is gone, or there is no descriptor left.
        """
        folder = None
        with contextlib.suppress(OSError):  # it was removed
            folder = os.getcwd()
        request = Request(tuple(imports), [str(place) for place in sys.path], dict(os.environ), folder)
        status, theirs = os.pipe()
        with contextlib.ExitStack() as stack:
            stack.callback(os.close, theirs)
            nowhere = os.open(os.devnull, os.O_RDWR)
            stack.callback(os.close, nowhere)
            try:
                socket.send_fds(self._socket, [b"!"], [descriptor, theirs, *(stream if _open(stream) else nowhere for stream in (1, 2))])
                self._connection.send(request)
            except BaseException:
                os.close(status)
                raise
        return Forked(status)

    def close(self) -> None:
        """Ask nothing more of it: it ends when those that it forked have ended."""
        self._connection.close()
        self._socket.close()

    def bury(self, at_once: bool = False) -> None:
        """Wait for its end."""
        if at_once:
            self._process.kill()
        self._process.wait()


_lock = threading.Lock()
_server: ForkServer | None = None


def fork(descriptor: int, imports: Sequence[str]) -> Forked:
    """A process from this process's server: `ForkServer.fork`.

    Args:
        imports: modules that the server imports first, if it has not yet.

    Raises:
        OSError: no server can be started, or it died.
    """
    global _server
    with _lock:
        if _server is not None and _server.usable:
            with contextlib.suppress(ConnectionError):  # it died just now
                return _server.fork(descriptor, imports)
        if _server is not None:
            _server.close()
            threading.Thread(target=_server.bury, daemon=True, name="bury fork server").start()
        _server = ForkServer(_read_at_import())
        return _server.fork(descriptor, imports)


@atexit.register
def _end() -> None:
    if _server is not None:
        _server.close()
        _server.bury(at_once=True)


def _forget() -> None:
    """In a fork of this process, which must not hold the connection: the server ends when this process does."""
    global _lock, _server
    if _server is not None:
        _server.close()
    _lock, _server = threading.Lock(), None


os.register_at_fork(after_in_child=_forget)


def _read_at_import() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith(_READ_AT_IMPORT)}


def _open(stream: int) -> bool:
    try:
        os.fstat(stream)
    except OSError:
        return False
    return True
