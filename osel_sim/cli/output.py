"""Messages of the package's logger on the terminal: notes as they are, warnings with `warning:` before them."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from osel_sim.core.shown import shown

LOGGER = "osel_sim"


class _Lines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        message = shown(record.getMessage())
        return message if record.levelno < logging.WARNING else f"{record.levelname.lower()}: {message}"


@contextmanager
def show_log() -> Iterator[None]:
    """Within, messages of the package go to standard error, notes included. A program that calls the package decides for itself what it shows."""
    logger, handler = logging.getLogger(LOGGER), logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines())
    level, propagate = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate
