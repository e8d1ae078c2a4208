"""What runs in a worker process of `osel_sim.core.processes`. It imports next to nothing, so that it follows its parent from its first moment.

What it unpickles comes from the process that started it, over a socket pair that no other process has.
"""

import contextlib
import gc
import os
import pickle
import queue
import sys
import threading
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from osel_sim.core.errors import OselError


@dataclass(frozen=True)
class Ready:
    """The worker's setup is done."""


@dataclass(frozen=True)
class Value:
    """The next result of the job at hand."""

    value: Any


@dataclass(frozen=True)
class Raised:
    """Setup or job raised this; the worker does nothing more."""

    error: Exception


def serve(descriptor: int) -> None:
    """Set up, then work on jobs until the parent ends this process, or ends itself.

    Args:
        descriptor: of the socket to the parent. It sends the pickled setup first, then a pickled `(job, start, end)` at a time.
    """
    os.set_inheritable(descriptor, False)  # processes started by jobs must not keep the connection open
    connection = Connection(descriptor)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(connection, inbox), daemon=True, name="follow parent").start()
    del sys.argv[1:]
    try:
        gc.disable()  # what the setup imports and opens is no garbage; to look through it again and again takes a tenth of its time
        work = pickle.loads(inbox.get())()
        gc.enable()
        _send(connection, Ready())
        while True:
            job, start, end = pickle.loads(inbox.get())
            for _, value in zip(range(start, end), work(job, start), strict=True):
                _send(connection, Value(value))
    except Exception as error:
        _send(connection, Raised(_portable(error)))
        inbox.get()  # nothing more comes: the parent ends this process


def _receive(connection: Connection, inbox: "queue.SimpleQueue[bytes]") -> None:
    """Take in what the parent sends; end the process as soon as the parent has ended, whatever else it is doing."""
    with contextlib.suppress(OSError, EOFError):
        while True:
            inbox.put(connection.recv_bytes())
    os._exit(0)


def _send(connection: Connection, message: object) -> None:
    content = pickle.dumps(message)
    try:
        connection.send_bytes(content)
    except OSError:  # the parent is gone
        os._exit(0)


def _portable(error: Exception) -> Exception:
    """The exception as something that can be sent; with the traceback here, unless it is one that users read."""
    if not isinstance(error, OselError | OSError):
        error.add_note("".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
