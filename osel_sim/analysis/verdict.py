"""Is routing worth it on this log? The answer, and the test that it rests on. One function, for whatever has a table of rewards and choices."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array
from osel_sim.analysis.streamed import Streamed, Units
from osel_sim.selection.registry import RECOMMENDED
from osel_sim.statistics.betting import advantage_bounds
from osel_sim.statistics.clustered import UnitMean, unit_mean

Decision = Literal["route", "do_not_route", "not_enough_data"]

ERROR = 0.05
"""Probability, at most, of advising to route where no tested selector is better than every single policy; and of advising against it where the gain
is above the margin."""

MARGIN = 0.02
"""A gain in reward a decision that is not worth routing for, unless told otherwise."""

POWER = 0.8
"""Probability with which so many more instances as are named would tell."""

FEWEST = 10
"""Units below which nothing is said."""

MOST = 1_000_000
"""More instances than that nobody records."""

GROWTH = 1.1
"""Numbers of instances that might tell are tried in such steps."""

LATE = 0.25
"""The share of a stream's decisions that counts as late: what a selector comes to once it has learned."""

METHOD = (
    "fixed sample: Student's t over units (instances of one scene, or of the same text, are one) of the gain in the last quarter of the streams over "
    "every single policy, with what units changed in what was learned; the error is divided over the tested selectors"
)
ANYTIME = (
    "anytime-valid, for whoever looks while data come in: betting with an empirical Bernstein correction on the gain over the whole stream, "
    "exponents averaged over seeds"
)


@dataclass(frozen=True)
class Played:
    """A table of rewards and who chose what. N instances, P policies, S seeds, T decisions.

    Attributes:
        policies: (P,) names.
        rewards: (N, P) mean over the repeats; no NaN.
        units: (N,).
        order: (S, T) instance of every decision.
        chosen: selector -> (S, T) column of the policy.
        routed: name of a supervised router -> (N,) reward of the policy that it names for an instance, learned from others. They bound what could be
            gained by a selector that learns better than the tested ones.
    """

    policies: tuple[str, ...]
    rewards: Array
    units: Units
    order: NDArray[np.int32]
    chosen: Mapping[str, NDArray[np.int16]]
    routed: Mapping[str, Array]

    @property
    def late(self) -> int:
        """First decision of the late part."""
        return late_from(self.order.shape[1])

    @property
    def best(self) -> int:
        """Column of the best single policy."""
        return int(self.rewards.mean(axis=0).argmax())

    @property
    def span(self) -> float:
        """Rewards lie within an interval of this length."""
        return float(self.rewards.max() - self.rewards.min())

    def gains(self, name: str, first: int = 0) -> list[UnitMean]:
        """What a selector has over each of the policies from decision `first` on, or a router on all instances."""
        if name in self.routed:
            numbers = np.bincount(self.units)
            sums = (np.bincount(self.units, weights=self.routed[name] - column) for column in self.rewards.T)
            return [unit_mean(own, numbers, rare=self.span) for own in sums]
        streamed = Streamed.of(self.order, self.chosen[name], len(self.policies), first)
        return [streamed.mean(self.rewards, self.units, column, self.span) for column in self.rewards.T]

    def contenders(self) -> list[int]:
        """Columns of policies that may be the best single one: that are not two standard errors of the difference below it."""
        numbers, best = np.bincount(self.units), self.rewards[:, self.best]
        below = [unit_mean(np.bincount(self.units, weights=best - column), numbers) for column in self.rewards.T]
        return [column for column, found in enumerate(below) if column == self.best or found.mean < 2.0 * found.error]


@dataclass(frozen=True)
class Gain:
    """What routing has over always the best single policy, in reward a decision.

    Attributes:
        over_best: over the policy that was best on this log.
        low, high: bounds on the gain over the policy that is best, whichever that is; each is wrong with a probability that was asked for.
    """

    over_best: UnitMean
    low: float
    high: float

    @property
    def mean(self) -> float:
        """Over the policy that was best on this log."""
        return self.over_best.mean

    def of_more(self, times: float) -> UnitMean:
        """What it would be of so many times as many units, if all else stays."""
        return replace(self.over_best, units=round(self.over_best.units * times), error=self.over_best.error / math.sqrt(times))

    @property
    def as_json(self) -> dict[str, Any]:
        """For a file: None where something is unbounded."""
        values = {"mean": self.mean, "low": self.low, "high": self.high, "error": self.over_best.error}
        return {**{key: _finite(value) for key, value in values.items()}, "units": self.over_best.units}


def gain(played: Played, name: str, first: int, low_error: float, high_error: float = ERROR) -> Gain:
    """Gain of a selector or router with its bounds.

    It is the smallest of the gains over the single policies. So a lower bound is the smallest of lower bounds, each at the full error (all would have
    to be wrong); an upper bound the smallest of upper bounds over the policies that may be the best one, who share the error.
    """
    found, may = played.gains(name, first), played.contenders()
    low = min(one.mean - one.half(low_error) for one in found)
    high = min(found[column].mean + found[column].half(high_error / len(may)) for column in may)
    return Gain(found[played.best], low, high)


def verdict(played: Played, tested: Sequence[str], margin: float = MARGIN, error: float | None = None) -> dict[str, Any]:
    """What to do: route with a selector; do not route; or not enough data to tell.

    Args:
        tested: selectors that may be advised, each with the same part of the allowed error. That there are others changes nothing.
        margin: of reward a decision; a gain below it is not worth routing for. >= 0.
        error: of each of the tested selectors; None: `ERROR` divided by their number.

    Returns:
        decision, selector (that is advised, or None), policy (the best single one), margin, more (instances that would tell, where there are not
        enough; None where no number would), ceiling (upper bound of all gains, of routers too), stake (what the selector that does best once it has
        learned gains over the best single policy, over the whole stream and late, with bounds; None without any), test (how it was found, with the
        late gain of every tested selector, and that of every router).
    """
    share = error or ERROR / max(1, len(tested))
    late = {name: gain(played, name, played.late, share) for name in tested}
    routed = {name: gain(played, name, 0, share) for name in played.routed}
    enough = min((found.over_best.units for found in late.values()), default=0) >= FEWEST
    proven = [name for name, found in late.items() if enough and found.low > 0.0]
    best = max(proven or late, key=lambda name: late[name].mean, default=None)
    ceiling = max((found.high for found in (*late.values(), *routed.values())), default=math.inf)
    decision: Decision = "route" if proven else "do_not_route" if enough and ceiling < margin else "not_enough_data"
    whole = None if best is None else gain(played, best, 0, share)
    return {
        "decision": decision,
        "selector": best if proven else None,
        "policy": played.policies[played.best],
        "margin": margin,
        "more": _more(late.values(), routed.values(), margin, share, played) if decision == "not_enough_data" else None,
        "ceiling": _finite(ceiling),
        "stake": None
        if best is None or whole is None
        else {
            "selector": best,
            "gain": whole.mean,
            "gain_bounds": [_finite(whole.low), _finite(whole.high)],
            "gain_late": late[best].mean,
            "gain_late_bounds": [_finite(late[best].low), _finite(late[best].high)],
        },
        "test": {
            "method": METHOD,
            "error": ERROR,
            "units": int(played.units.max()) + 1,
            "instances": len(played.units),
            "advantages": {name: found.as_json for name, found in late.items()},
            "routers": {name: found.as_json for name, found in routed.items()},
            "anytime": None if best is None else _anytime(played, best, share),
        },
    }


def advisable(learners: Sequence[str], halved: bool, wanted: Sequence[str] | None = None) -> tuple[list[str], float]:
    """Selectors that a verdict may advise, and the error that each is tested with.

    Those that we recommend, of the learners that there are; where none of them is there, whoever left them out meant the others, and all are tested.
    The recommended ones have the same error whether both are there or one: naming more or fewer selectors must not turn a verdict.

    Args:
        halved: whether selectors can be shown the log's other half beforehand.
        wanted: the selectors that the user wants tested; None: not said.
    """
    recommended = [RECOMMENDED, f"{RECOMMENDED}:warm"] if halved else [RECOMMENDED]
    named = list(dict.fromkeys(recommended if wanted is None else wanted))
    found = [name for name in named if name in learners]
    return (found, ERROR / len(named)) if found else (list(learners), ERROR / max(1, len(learners)))


def late_from(decisions: int) -> int:
    """First decision of the late part of a stream."""
    return decisions - max(1, int(decisions * LATE))


def _more(tested: Iterable[Gain], routed: Iterable[Gain], margin: float, share: float, played: Played) -> int | None:
    """How many more instances would probably tell, one way or the other, if gains are what they seem; None where no number would."""
    tested = list(tested)
    everything, luck, against = [*tested, *routed], NormalDist().inv_cdf(POWER), ERROR / len(played.contenders())
    times = max(GROWTH, FEWEST / (int(played.units.max()) + 1))
    while tested and (more := len(played.units) * (times - 1.0)) <= MOST:
        grown = [found.of_more(times) for found in everything]
        proven = any(found.mean > found.half(share) + luck * found.error for found in grown[: len(tested)])
        if proven or all(found.mean + found.half(against) + luck * found.error < margin for found in grown):
            return _rounded(more)
        times *= GROWTH
    return None


def _anytime(played: Played, name: str, error: float) -> dict[str, Any]:
    chosen, base = played.chosen[name].astype(np.int64), played.rewards[:, played.best]
    differences = played.rewards[played.order, chosen] - base[played.order]
    low, high = advantage_bounds(differences, played.span, error) if played.span > 0.0 else (0.0, 0.0)
    return {"method": ANYTIME, "selector": name, "mean": float(differences.mean()), "low": low, "high": high}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(value: float) -> int:
    """Up, to two digits."""
    unit = 10.0 ** max(0, math.floor(math.log10(max(value, 1.0))) - 1)
    return round(math.ceil(value / unit) * unit)
