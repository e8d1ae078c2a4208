"""Did it get worse? Differences between policies on the same instances with paired intervals, and a verdict that claims no more than was shown."""

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Literal

import numpy as np

from osel_sim.analysis.log import Array
from osel_sim.analysis.pairing import MEASURES, Contender, Pairs, pair
from osel_sim.analysis.until_decided import ERROR, FEWEST
from osel_sim.formats.compare_schema import EXIT_CODES, Decision
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.intervals import Interval
from osel_sim.statistics.paired import Discordance, holm, letters, mean_interval, sign_flip_midp, success_interval
from osel_sim.statistics.sequential import anytime_bounds, anytime_p, pairs_to_tell


def compare(contenders: Sequence[Contender], weights: RewardWeights, margin: float, power: float = 0.8) -> dict[str, Any]:
    """All pairs of policies, as `compare.json` has them; the verdict compares each of the others with the first.

    Args:
        contenders: at least two; the first is what the others are measured by.
        margin: how much lower a rate of success may be to count as no worse, in [0, 1).
        power: probability with which the instances that are said to be needed would tell, in (0, 1).

    Raises:
        DataError: two of them have no instance in common, or the logs do not fit together.
    """
    paired = [pair(one, other, weights) for one, other in combinations(contenders, 2)]
    probabilities = [_probability(pairs) for pairs in paired]
    tested = zip(paired, probabilities, holm(probabilities), strict=True)
    found = [_compared(pairs, (probability, adjusted), len(paired), margin, power) for pairs, probability, adjusted in tested]
    first = contenders[0].name
    decisions: list[Decision] = [entry["verdict"]["decision"] for entry in found if entry["first"] == first]
    decision: Decision = next(one for one in ("worse", "not enough data", "no worse", "better") if one in decisions)
    return {
        "policies": [_about(contender) for contender in contenders],
        "margin": margin,
        "error": ERROR,
        "power": power,
        "reward": {name: value for name, value in vars(weights).items() if not name.startswith("_")},
        "pairs": found,
        "letters": _letters(contenders, found) if len(contenders) > 2 else None,
        "verdict": {
            "decision": decision,
            "text": " ".join(entry["verdict"]["text"] for entry in found if entry["first"] == first),
            "exit_code": EXIT_CODES[decision],
        },
    }


def compare_pairs(pairs: Pairs, margin: float, power: float = 0.8) -> dict[str, Any]:
    """Two policies alone, as an entry of `pairs` in `compare.json`."""
    probability = _probability(pairs)
    return _compared(pairs, (probability, probability), 1, margin, power)


def plan(contenders: Sequence[Contender], weights: RewardWeights, detect: float, margin: float, power: float = 0.8) -> list[dict[str, Any]]:
    """Instances needed for each pair of policies, from how often one of the two solves what the other does not.

    Args:
        detect: difference of success to find, in (0, 1].
        margin: that equal policies are to be told no worse by.
    """
    found = []
    every = list(combinations(contenders, 2))
    for one, other in every:
        pairs = pair(one, other, weights)
        discordance = _discordance(pairs)
        needed = discordance.instances(detect, power, ERROR / len(every))
        found.append(
            {
                "first": one.name,
                "second": other.name,
                "instances": len(pairs.keys),
                "discordant": float(np.abs(pairs.differences()).mean()),
                "detect": detect,
                "power": power,
                "needed": needed,
                "more": max(needed - len(pairs.keys), 0),
                "margin": margin,
                "needed_for_no_worse": discordance.instances(margin, power, ERROR / len(every)) if margin else None,
            }
        )
    return found


def _compared(pairs: Pairs, probabilities: tuple[float, float], comparisons: int, margin: float, power: float) -> dict[str, Any]:
    """One pair of policies; `probabilities`: of the test, alone and with Holm's correction."""
    differences = pairs.differences()
    whole = bool(np.isin(differences, (-1.0, 0.0, 1.0)).all() and np.isin(pairs.first_values["success"], (0.0, 1.0)).all())
    measured = {name: entry for name in MEASURES if name in pairs.first_values and (entry := _difference(pairs, name)) is not None}
    return {
        "first": pairs.first.name,
        "second": pairs.second.name,
        "instances": len(pairs.keys),
        "pairs_of_repeats": pairs.repeats,
        "unpaired": {"first": pairs.only_first, "second": pairs.only_second},
        "errors": {"first": pairs.errors[0], "second": pairs.errors[1]},
        "same_scene": pairs.scenes,
        "looks": None if pairs.looks is None else len(pairs.looks.ends),
        "differences": measured,
        "missing": dict(pairs.missing),
        "test": {
            "method": _method(pairs, whole),
            "gained": int((differences > 0.0).sum()),
            "lost": int((differences < 0.0).sum()),
            "p": probabilities[0],
            "p_holm": probabilities[1],
        },
        "tasks": _tasks(pairs),
        "flips": [
            {"instance": pairs.keys[row], "task": pairs.tasks[row], "first": float(one), "second": float(other)}
            for row, (one, other) in enumerate(zip(pairs.first_values["success"], pairs.second_values["success"], strict=True))
            if one != other
        ],
        "verdict": _verdict(pairs, probabilities[1], comparisons, margin, power),
    }


def _difference(pairs: Pairs, measure: str) -> dict[str, Any] | None:
    """Means of both and their difference on the instances where both are known; None where there is none."""
    differences = pairs.differences(measure)
    known = np.isfinite(differences)
    if not known.any():
        return None
    interval = _bounds(pairs, ERROR) if measure == "success" else mean_interval(differences[known])
    return {
        "instances": int(known.sum()),
        "first": float(pairs.first_values[measure][known].mean()),
        "second": float(pairs.second_values[measure][known].mean()),
        "difference": float(differences[known].mean()),
        "ci95": None if interval is None else list(interval),
    }


def _tasks(pairs: Pairs) -> dict[str, dict[str, Any]]:
    """The difference of success on each task, with Holm's correction over them; nothing where there is one task."""
    labels, differences = np.array(pairs.tasks), pairs.differences()
    names = sorted(set(pairs.tasks))
    if len(names) < 2:
        return {}
    parts = {name: labels == name for name in names}
    probabilities = [sign_flip_midp(differences[part]) for part in parts.values()]
    return {
        name: {
            "instances": int(part.sum()),
            "first": float(pairs.first_values["success"][part].mean()),
            "second": float(pairs.second_values["success"][part].mean()),
            "difference": float(differences[part].mean()),
            "ci95": list(success_interval(differences[part], most=pairs.repeats * part.mean())),
            "p": probability,
            "p_holm": adjusted,
            "decision": _told_apart(differences[part], adjusted),
        }
        for (name, part), probability, adjusted in zip(parts.items(), probabilities, holm(probabilities), strict=True)
    }


def _told_apart(differences: Array, adjusted: float) -> Literal["better", "worse"] | None:
    if len(differences) < FEWEST or adjusted > ERROR:
        return None
    return "better" if differences.mean() > 0.0 else "worse"


def _verdict(pairs: Pairs, adjusted: float, comparisons: int, margin: float, power: float) -> dict[str, Any]:
    differences = pairs.differences()
    low, high = _bounds(pairs, ERROR / comparisons)
    told = _told_apart(differences, adjusted)
    decision: Decision = "not enough data"
    if told == "better" and low > 0.0:
        decision = "better"
    elif len(differences) >= FEWEST and low > -margin:
        decision = "no worse"
    elif told == "worse" and high < 0.0:
        decision = "worse"
    more = None if decision != "not enough data" else _more(pairs, comparisons, margin, power)
    return {"decision": decision, "low": low, "high": high, "more": more, "text": _text(pairs, decision, (low, high), margin, more, told)}


def _text(pairs: Pairs, decision: Decision, interval: tuple[float, float], margin: float, more: int | None, told: str | None) -> str:
    first, second = pairs.first.name, pairs.second.name
    low, high = (f"{100 * end:+.1f}" for end in interval)
    seen = f"{100 * pairs.differences().mean():+.1f} points of success (between {low} and {high}) on {len(pairs.keys)} instances"
    bound = f"{100 * margin:g} points"
    if decision == "no worse":
        within = f" It is lower, but by less than {bound}." if told == "worse" else ""
        return f"{second} is no worse than {first} by a margin of {bound}: {seen}.{within}"
    if decision != "not enough data":
        return f"{second} is {decision} than {first}: {seen}."
    enough = "no number of instances would tell equal policies with a margin of 0" if more is None else f"about {more} more instances would tell"
    return f"Not enough data to tell whether {second} is worse than {first}: {seen}; {enough}."


def _more(pairs: Pairs, comparisons: int, margin: float, power: float) -> int | None:
    """How many more instances would tell, if the difference stays what it is: rounded up to two digits."""
    needed = _needed(pairs, ERROR / comparisons, margin, power)
    if not math.isfinite(needed):
        return None
    more = math.ceil(max(needed, FEWEST)) - len(pairs.keys)
    unit: int = 10 ** max(int(math.log10(max(more, 1))) - 1, 0)
    return max(math.ceil(more / unit) * unit, 1)


def _needed(pairs: Pairs, error: float, margin: float, power: float) -> float:
    """Instances that would tell, if the difference stays what it is; infinite if none would."""
    differences = pairs.differences()
    if pairs.looks is not None:
        sides = ((differences, 0.0), (-differences, 0.0), (differences, -min(margin, 0.99)))
        return min(pairs_to_tell(values, below, error / 2.0) for values, below in sides)
    difference, discordance = float(differences.mean()), _discordance(pairs)
    distances = [distance for distance in (abs(difference), difference + margin) if distance > 1e-9]
    return min((discordance.instances(min(distance, 1.0), power, error) for distance in distances), default=math.inf)


def _bounds(pairs: Pairs, error: float) -> Interval:
    """Of the difference of success; where a log was stopped by what it showed, such that hold at every look."""
    if pairs.looks is None:
        return success_interval(pairs.differences(), 1.0 - error, pairs.repeats)
    return anytime_bounds(pairs.differences()[list(pairs.looks.order)], pairs.looks.ends, error / 2.0)[-1]


def _method(pairs: Pairs, whole: bool) -> str:
    if pairs.looks is not None:
        return "bets on the difference, at any time"
    return "exact McNemar, mid-p" if whole else "sign flips of the instances' differences, mid-p"


def _discordance(pairs: Pairs) -> Discordance:
    return Discordance.of(pairs.differences(), pairs.repeats)


def _probability(pairs: Pairs) -> float:
    if pairs.looks is None:
        return sign_flip_midp(pairs.differences())
    return anytime_p(pairs.differences()[list(pairs.looks.order)], pairs.looks.ends)


def _about(contender: Contender) -> dict[str, Any]:
    return {"name": contender.name, "policy": contender.policy, "log": str(contender.log.source)}


def _letters(contenders: Sequence[Contender], found: Sequence[dict[str, Any]]) -> dict[str, str]:
    """The compact letter display, the highest rate of success first."""
    means = {
        contender.name: float(
            np.mean([entry["differences"]["success"][side] for entry in found for side in ("first", "second") if entry[side] == contender.name])
        )
        for contender in contenders
    }
    apart = [(entry["first"], entry["second"]) for entry in found if entry["instances"] >= FEWEST and entry["test"]["p_holm"] <= ERROR]
    return letters(sorted(means, key=lambda name: -means[name]), apart)
