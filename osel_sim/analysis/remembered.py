"""What was computed from a log a moment ago: a replay, its page, its curve and the log's own page ask for the same things, which take seconds."""

from collections.abc import Callable

from osel_sim.analysis.log import FLAGS, MEASURES, LoggedOutcomes
from osel_sim.core.files import content_digest

MOST = 8
"""Results that are kept; they are small."""


class Remembered[Value]:
    """The last few results of a function of a log, which nobody must change."""

    def __init__(self) -> None:
        self._found: dict[str, Value] = {}

    def __call__(self, log: LoggedOutcomes, settings: object, compute: Callable[[], Value]) -> Value:
        """What was computed for a log of the same content and the same settings, else what is computed now.

        Args:
            settings: all else that the result depends on, as its `repr` tells it.
        """
        key = content_digest(fingerprint(log), repr(settings))
        found = self._found.pop(key) if key in self._found else compute()
        self._found[key] = found  # the last one now
        for old in list(self._found)[:-MOST]:
            del self._found[old]
        return found


def fingerprint(log: LoggedOutcomes) -> str:
    """A digest of everything in a log that results can depend on: not of the folder it lies in."""
    arrays = [getattr(log, name) for name in (*MEASURES, *FLAGS, "contexts")]
    about = (log.instances, log.policies, log.encoder, log.skills and log.skills.digest, [(array.shape, array.dtype.str) for array in arrays])
    return content_digest(repr(about), *(array.tobytes() for array in arrays))
