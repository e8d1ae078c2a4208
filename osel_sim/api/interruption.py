"""Ctrl-C in a live run: the first one lets the decision at hand come to its end."""

import logging
import signal
import threading
from typing import Any

logger = logging.getLogger(__name__)


class Interrupt:
    """Within, the first Ctrl-C asks to stop after the decision at hand; the second one raises KeyboardInterrupt.

    Signals only reach the main thread; in another one nothing is changed.
    """

    def __init__(self) -> None:
        self.asked = False
        self._before: Any = None

    def __enter__(self) -> "Interrupt":
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._before)

    def _ask(self, *_: object) -> None:
        self.asked = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        logger.info("\nfinishing this decision; Ctrl-C again leaves at once")
