"""What runs in the fork server (`osel_sim.core.fork_server`) and in the processes that it forks."""

import contextlib
import gc
import importlib
import os
import select
import signal
import socket
import sys
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import NoReturn


@dataclass(frozen=True)
class Request:
    """A process that is to be forked.

    Attributes:
        imports: modules to be imported before.
        path: where it imports from.
        environment: all of it; variables that the imports set are added.
        folder: where it works; None: where the server does.
    """

    imports: tuple[str, ...]
    path: list[str]
    environment: dict[str, str]
    folder: str | None


def serve_forks(descriptor: int) -> None:
    """Fork processes until the one that asks for them ends, and those have ended.

    Args:
        descriptor: of the socket on which requests come, each after the descriptors of the process: its socket, where its status is told, and its
            standard output and error.
    """
    asked = socket.socket(fileno=descriptor)
    asked.set_inheritable(False)
    requests = Connection(os.dup(descriptor))
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    forked: dict[int, Connection] = {}
    before = dict(os.environ)
    listening: list[socket.socket | int] = [asked, woken]
    while asked in listening or forked:
        ready, _, _ = select.select(listening, [], [])
        if woken in ready:
            os.read(woken, 4096)
            _bury(forked)
        if asked in ready:
            try:
                _, descriptors, _, _ = socket.recv_fds(asked, 1, 4, socket.MSG_CMSG_CLOEXEC)
                request: Request = requests.recv()
            except (EOFError, OSError):
                listening.remove(asked)
                continue
            _import(request)
            request.environment.update({name: value for name, value in os.environ.items() if name not in before and name not in request.environment})
            status = Connection(descriptors[1], readable=False)
            if (pid := os.fork()) == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                asked.close()
                for connection in (requests, status, *forked.values()):
                    connection.close()
                os.close(woken)
                os.close(wake)
                _run(request, descriptors)
            forked[pid] = status
            for one in (descriptors[0], *descriptors[2:]):
                os.close(one)
            _tell(status, pid)


def _import(request: Request) -> None:
    """Import what was not yet. What fails fails again where it is needed, and is told there."""
    sys.path[:] = request.path
    importlib.invalidate_caches()
    for name in request.imports:
        if name not in sys.modules:
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    gc.collect()
    gc.freeze()  # what is imported stays, and is not looked through, in memory that all share


def _bury(forked: dict[int, Connection]) -> None:
    """Tell the exit codes of those that ended."""
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if pid == 0:
            return
        if connection := forked.pop(pid, None):
            _tell(connection, os.waitstatus_to_exitcode(status))
            connection.close()


def _tell(status: Connection, number: int) -> None:
    with contextlib.suppress(OSError):  # nobody listens
        status.send(number)


def _run(request: Request, descriptors: list[int]) -> NoReturn:
    """In the child: become what a fresh interpreter would be, and serve."""
    code = 1
    try:
        os.setsid()
        for stream, descriptor in zip((1, 2), descriptors[2:], strict=True):
            os.dup2(descriptor, stream)
            os.close(descriptor)
        os.environ.clear()
        os.environ.update(request.environment)
        if request.folder is not None:
            os.chdir(request.folder)
        if "numpy" in sys.modules:
            sys.modules["numpy"].random.seed()  # its global generator would be the same in all; Python's sees to that itself
        from osel_sim.core.worker import serve

        serve(descriptors[0])
        code = 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
