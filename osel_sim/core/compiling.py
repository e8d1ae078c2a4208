"""Says when numba compiles: that takes as long as many episodes, happens once on a machine, and nothing else shows it."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

logger = logging.getLogger(__name__)


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Within, what numba compiles, and does not find in its cache, is announced by one message.

    Args:
        what: is compiled, in words.
    """
    from numba.core import event

    said: list[Any] = []

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            if not said:
                said.append(event)
                logger.info("compiling %s, once on this machine (up to a minute) ...", what)

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield
