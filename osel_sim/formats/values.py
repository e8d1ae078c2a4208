"""What a field of a journal's line or a log's row may hold, and what is wrong with one that does not."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from osel_sim.formats.toml_types import quoted
from osel_sim.interface.outcome import MONITORED_VERSION

_LARGEST = 2**63
"""Integers are below it in the columns of a rollout log."""


@dataclass(frozen=True)
class Kind:
    """What a field may hold.

    Attributes:
        wanted: in words, after "must be".
        fits: whether a value is one of these.
    """

    wanted: str
    fits: Callable[[Any], bool]

    @property
    def or_null(self) -> "Kind":
        """The same, or nothing."""
        return Kind(f"{self.wanted} or null", lambda value: value is None or self.fits(value))


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and -1e300 < value < 1e300  # NaN is in no range


TEXT = Kind("text", lambda value: isinstance(value, str))
NAME = Kind("text that is not empty", lambda value: isinstance(value, str) and value != "")
TEXTS = Kind("an object of texts", lambda value: isinstance(value, dict) and all(item is None or isinstance(item, str) for item in value.values()))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
COUNT = Kind("an integer of 0 or more", lambda value: type(value) is int and 0 <= value < _LARGEST)
NUMBER = Kind("a finite number", _is_number)
AMOUNT = Kind("a finite number of 0 or more", lambda value: _is_number(value) and value >= 0)
SHARE = Kind("a number in [0, 1]", lambda value: _is_number(value) and 0 <= value <= 1)


def only(number: int) -> Kind:
    """This number alone, such as the version of a form."""
    return Kind(f"{number}", lambda value: type(value) is int and value == number)


def _are_propensities(value: Any) -> bool:
    if not isinstance(value, dict) or not all(NAME.fits(name) and AMOUNT.fits(share) for name, share in value.items()):
        return False
    return math.isclose(math.fsum(value.values()), 1.0, abs_tol=1e-6)  # as close as `osel_sim.interface.selector.Choice` asks for


PROPENSITIES = Kind("probabilities of policies that sum to 1", _are_propensities)

TIMES = {"upload": AMOUNT, "inference": AMOUNT, "download": AMOUNT, "motion": AMOUNT}
"""Of `osel_sim.interface.outcome.Seconds`."""
SECONDS = Kind(f"an object of {', '.join(TIMES)}, each {AMOUNT.wanted}", lambda value: isinstance(value, dict) and fault(value, TIMES) is None)

_END = {"success": FLAG, "subgoals": SHARE, "steps": COUNT}
_USED = {"calls": COUNT, "actions": COUNT, "price": AMOUNT}
_TOLD = {"fallback": TEXT.or_null, "error": TEXT.or_null, "fallback_steps": COUNT.or_null}
OUTCOME = {**_END, "seconds": SECONDS, **_USED, **_TOLD}
"""Of `osel_sim.interface.outcome.Outcome`."""


def _is_monitored(value: Any) -> bool:
    if not isinstance(value, dict) or fault(value, _MONITORED) is not None:
        return False
    handoffs, by_policy = value["handoffs"], value["by_policy"]
    return all(isinstance(one, dict) and fault(one, _HANDOFF) is None for one in handoffs) and all(
        NAME.fits(policy) and isinstance(driving, dict) and fault(driving, _DRIVING) is None for policy, driving in by_policy.items()
    )


_HANDOFF = {"step": COUNT, "call": COUNT, "from": NAME, "to": NAME, "why": TEXT}
_DRIVING = {"steps": COUNT, **_USED}
_DUTY = {"steps": SHARE, "calls": SHARE}
_MONITORED = {
    "version": only(MONITORED_VERSION),
    "points": COUNT,
    "handoffs": Kind("a list", lambda value: isinstance(value, list)),
    "duty": Kind("an object of shares", lambda value: isinstance(value, dict) and fault(value, _DUTY) is None),
    "by_policy": Kind("an object", lambda value: isinstance(value, dict)),
}
MONITORED = Kind(f"version {MONITORED_VERSION} of handoffs, duty and what each policy had of an episode", _is_monitored)
"""Of `osel_sim.interface.outcome.Monitored`."""
DECISION = {
    **{"index": COUNT, "task": NAME, "seed": COUNT, "level": COUNT, "axes": NAME.or_null, "split": NAME},
    **{"instruction": TEXT, "phrasing": TEXT, "target": TEXT, "container": TEXT, "policy": NAME, "propensities": PROPENSITIES},
    **{**_END, "seconds": SECONDS, **_USED, "reward": NUMBER.or_null, **_TOLD, "robot": NAME.or_null, "scene": NAME.or_null},
    "monitored": MONITORED.or_null,
}
"""Of `osel_sim.formats.journal.Decision`."""
ROW = {
    **{"task": TEXT, "instance": NAME, "seed": COUNT.or_null, "level": COUNT.or_null, "axes": TEXT.or_null, "split": TEXT.or_null},
    **{name: TEXT.or_null for name in ("instruction", "phrasing", "target", "container", "robot")},
    **{"policy": NAME, "repeat": COUNT, "success": FLAG, "subgoals": SHARE.or_null, "steps": COUNT.or_null, "score": NUMBER.or_null},
    **{name: AMOUNT.or_null for name in ("upload", "inference", "download", "motion", "price")},
    **{"calls": COUNT.or_null, "actions": COUNT.or_null, **_TOLD, "scene": NAME.or_null},
}
"""Of `osel_sim.formats.rollout_log.Row`."""


def fault(values: Mapping[str, Any], kinds: Mapping[str, Kind], optional: tuple[str, ...] = ()) -> str | None:
    """What is wrong with a line or a row, the field named; None where nothing is.

    Args:
        kinds: field -> what it may hold.
        optional: fields that may be missing.
    """
    for name in values:
        if name not in kinds:
            return f"has an unknown field {quoted(name)}"
    for name, kind in kinds.items():
        if name not in values:
            if name in optional:
                continue
            return f"{name} is missing"
        if not kind.fits(values[name]):
            return f"{name} must be {kind.wanted}, got {quoted(values[name])}"
    return None
