"""What changes in a replayed stream: policies that join and leave, prices that change, policies that become what another one is.

remote_large@500                       --join, --leave: from decision 500 on (counted from 0) it is there, or gone
price:remote_large:x2@800              --drift: it costs twice as much as in the log
remote_large=local_small@800           --drift: it comes to what local_small came to, at its own price
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import SettingError, UnknownNameError, did_you_mean

Kind = Literal["join", "leave", "price", "outcomes"]
DRIFTS = ("price:POLICY:xFACTOR@DECISION", "POLICY=OTHER@DECISION")
"""Forms of `--drift`."""


@dataclass(frozen=True)
class StreamChange:
    """One change.

    Attributes:
        at: the first decision that it holds for.
        factor: of `price`, what it is multiplied by, from the log's.
        other: of `outcomes`, the policy whose outcomes are taken; itself where it becomes what it was.
    """

    at: int
    kind: Kind
    policy: str
    factor: float = 1.0
    other: str = ""

    @property
    def words(self) -> str:
        """In words."""
        what = {"join": "joins", "leave": "leaves", "price": f"costs x{self.factor:g}", "outcomes": f"does as {self.other}"}
        return f"{self.policy} {what[self.kind]} at decision {self.at}"


@dataclass(frozen=True)
class Span:
    """Decisions between two changes. P policies.

    Attributes:
        start, stop: of its decisions; the latter is none of them.
        available: bool (P,), which may be chosen.
        source: (P,) column of the policy whose success and time each one comes to.
        factor: (P,) what each one's price is multiplied by.
        changes: those that it begins with.
    """

    start: int
    stop: int
    available: NDArray[np.bool_]
    source: NDArray[np.int64]
    factor: NDArray[np.float64]
    changes: tuple[StreamChange, ...] = ()

    @property
    def columns(self) -> NDArray[np.int64]:
        """Of the policies that may be chosen."""
        return np.flatnonzero(self.available)

    @property
    def decisions(self) -> slice:
        """Its part of a stream."""
        return slice(self.start, self.stop)


@dataclass(frozen=True)
class Timeline:
    """The changes of a stream.

    Attributes:
        policies: (P,) of the log.
        changes: in the order of their decisions.
        decisions: length of the stream.
    """

    policies: tuple[str, ...]
    changes: tuple[StreamChange, ...]
    decisions: int

    @cached_property
    def spans(self) -> tuple[Span, ...]:
        """The stream in pieces in which nothing changes; the first lies before all changes."""
        first = {policy: next((change.kind for change in self._of(policy) if change.kind in ("join", "leave")), "leave") for policy in self.policies}
        available = np.array([first[policy] == "leave" for policy in self.policies])
        source, factor = np.arange(len(self.policies)), np.ones(len(self.policies))
        ends = [0, *dict.fromkeys(change.at for change in self.changes), self.decisions]
        found = []
        for start, stop in pairwise(ends):
            own = tuple(change for change in self.changes if change.at == start)
            for change in own:
                column = self.policies.index(change.policy)
                if change.kind == "price":
                    factor[column] = change.factor
                elif change.kind == "outcomes":
                    source[column] = self.policies.index(change.other)
                else:
                    available[column] = change.kind == "join"
            found.append(Span(start, stop, available.copy(), source.copy(), factor.copy(), own))
        return tuple(found)

    def _of(self, policy: str) -> list[StreamChange]:
        return [change for change in self.changes if change.policy == policy]


def timeline(join: Sequence[str], leave: Sequence[str], drift: Sequence[str], policies: Sequence[str], decisions: int) -> Timeline:
    """Read the changes of a stream.

    Args:
        join, leave: `POLICY@DECISION` each. drift: see the top of this file.
        policies: of the log.
        decisions: length of the stream.

    Raises:
        SettingError: one of another form, at a decision that the stream does not have, or that cannot be.
        UnknownNameError: a policy that the log does not have.
    """
    found = [_membership("join", text, policies, decisions) for text in join]
    found += [_membership("leave", text, policies, decisions) for text in leave]
    found += [_drift(text, policies, decisions) for text in drift]
    found.sort(key=lambda change: change.at)  # stable: what is said of one decision keeps its order, those that join first
    for policy in policies:
        _check_turns([change for change in found if change.policy == policy and change.kind in ("join", "leave")])
    for one, other in pairwise(sorted(found, key=lambda change: (change.policy, change.kind, change.at))):
        if (one.policy, one.kind, one.at) == (other.policy, other.kind, other.at):
            raise SettingError("drift", f"{one.words} and {other.words}: say one of them")
    result = Timeline(tuple(policies), tuple(found), decisions)
    for span in result.spans:
        if not span.available.any():
            setting = "leave" if span.start else "join"
            raise SettingError(setting, f"no policy is there at decision {span.start}; one of {', '.join(policies)} must be")
    return result


def _membership(kind: Literal["join", "leave"], text: str, policies: Sequence[str], decisions: int) -> StreamChange:
    policy, at, place = text.rpartition("@")
    if not at:
        raise SettingError(kind, f"must be POLICY@DECISION, such as {text or policies[-1]}@{decisions // 2}, got {text!r}")
    return StreamChange(_decision(kind, text, place, decisions), kind, _known(policy, policies, f"--{kind} {text}"))


def _drift(text: str, policies: Sequence[str], decisions: int) -> StreamChange:
    what, at, place = text.rpartition("@")
    if not at:
        raise SettingError("drift", f"must be {' or '.join(DRIFTS)}, got {text!r}, which names no decision")
    where = f"--drift {text}"
    policy, equals, other = what.partition("=")
    if equals:
        names = _known(policy, policies, where), _known(other, policies, where)
        return StreamChange(_decision("drift", text, place, decisions), "outcomes", names[0], other=names[1])
    measure, _, rest = what.partition(":")
    policy, colon, times = rest.rpartition(":")
    if measure != "price":
        raise SettingError("drift", f"must be {' or '.join(DRIFTS)}, got {text!r}: {did_you_mean(measure, ['price'])}only prices can be multiplied")
    if not colon or not times.startswith("x"):
        raise SettingError("drift", f"must be {DRIFTS[0]}, such as price:{policy or rest or policies[-1]}:x2@{place}, got {text!r}")
    try:
        factor = float(times[1:])
    except ValueError:
        factor = math.nan
    if not (math.isfinite(factor) and factor >= 0.0):
        raise SettingError("drift", f"a price is multiplied by a number of 0 or more, such as x2, got {times!r} in {text!r}")
    return StreamChange(_decision("drift", text, place, decisions), "price", _known(policy, policies, where), factor)


def _decision(setting: str, text: str, place: str, decisions: int) -> int:
    if not (place.isascii() and place.isdigit() and 1 <= int(place) < decisions):
        wanted = f"an integer from 1 to {decisions - 1}, since the stream has {decisions}"
        raise SettingError(setting, f"the decision must be {wanted}, got {place!r} in {text!r}")
    return int(place)


def _known(policy: str, policies: Sequence[str], where: str) -> str:
    if policy not in policies:
        raise UnknownNameError("policy", policy, policies, where)
    return policy


def _check_turns(changes: Sequence[StreamChange]) -> None:
    """A policy joins and leaves in turn."""
    for one, other in pairwise(changes):
        if one.kind == other.kind:
            opposite = "leave" if other.kind == "join" else "join"
            raise SettingError(other.kind, f"{one.words} and {other.words}: it must {opposite} in between")
        if one.at == other.at:
            raise SettingError("leave", f"{one.words} and {other.words}: it cannot do both at once")
