"""Messages of the package's logger on the terminal: notes as they are, warnings with `warning:` before them. What libraries warn of is not shown."""

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from osel_sim.core.shown import shown

LOGGER = "osel_sim"
_VARIABLE = "PYTHONWARNINGS"


class _Lines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        message = shown(record.getMessage())
        return message if record.levelno < logging.WARNING else f"{record.levelname.lower()}: {message}"


@contextmanager
def show_log() -> Iterator[None]:
    """Within, messages of the package go to standard error, notes included. A program that calls the package decides for itself what it shows.

    Warnings of libraries speak of their code and not of what the user did. They stay unsaid, unless they are asked for (`python -W default`).
    """
    logger, handler = logging.getLogger(LOGGER), logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines())
    level, propagate = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        with _quiet_libraries():
            yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = propagate


@contextmanager
def _quiet_libraries() -> Iterator[None]:
    """Within, no warnings of libraries are printed: neither Python's, here and in child processes, nor those of loggers that nobody set up."""
    if sys.warnoptions:
        yield
        return
    fallback = logging.lastResort
    level = fallback.level if fallback is not None else logging.WARNING
    os.environ[_VARIABLE] = "ignore"
    try:
        if fallback is not None:
            fallback.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        os.environ.pop(_VARIABLE, None)
        if fallback is not None:
            fallback.setLevel(level)
