"""Running a policy server in this process until it is told to stop."""

import asyncio
import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from osel_sim.core.shown import shown

if TYPE_CHECKING:
    from osel_sim.remote.server import PolicyServer

GRACE_SECONDS = 2.0  # for an inference that is still running when everything else has stopped


def run_until_signal(server: "PolicyServer", ready: Callable[[int], None]) -> None:
    """Serve until SIGTERM or SIGINT.

    Args:
        ready: called with the port as soon as clients can connect.
    """

    async def run() -> None:
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await server.run(stop, ready)

    asyncio.run(run())
    # Python waits for the inference thread at exit; one that never returns must not keep the process.
    last_resort = threading.Timer(GRACE_SECONDS, os._exit, [1])
    last_resort.daemon = True
    last_resort.start()


def stop_with_stdin(descriptor: int = 0) -> None:
    """Stop this process when whoever holds the other end of standard input is gone.

    Args:
        descriptor: of it, where it has been put elsewhere.
    """
    while os.read(descriptor, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(10.0)
    os._exit(1)  # whatever kept it


class ShownFormatter(logging.Formatter):
    """Log lines without secrets and control characters: clients have a say in them."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return shown(super().format(record))
