"""What a rollout log says: success of every policy, overall and split by object, container and phrasing."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console

from osel_sim.cli.console import MOST_POLICIES, Table, number, percent
from osel_sim.formats.levels import label
from osel_sim.formats.rollout_log import Row
from osel_sim.interface.outcome import credited
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.selection.reward import RewardWeights, row_rewards, row_seconds
from osel_sim.statistics.best import share_of_best
from osel_sim.statistics.intervals import effective_trials, wilson_interval

_MOST_COLUMNS = 12
"""A column for each of more policies is too narrow to be read."""
SPLITS: dict[str, Callable[[Row], str | None]] = {
    "task": lambda row: row.task,
    "robot": lambda row: row.robot or DEFAULT_ROBOT,
    "level": lambda row: None if row.level is None else label(row.level, row.axes),
    "task at level": lambda row: None if row.level is None else f"{row.task} {label(row.level, row.axes)}",
    "object": lambda row: row.target or None,
    "container": lambda row: row.container or None,
    "phrasing": lambda row: None if not row.phrasing else row.phrasing.rpartition("-")[0].replace("_", "-") or row.phrasing,
}
"""What the rows are split by; None where a log from elsewhere does not have it."""


def print_rollouts(console: Console, rows: Sequence[Row], weights: RewardWeights) -> None:
    """Print the tables. Episodes that ended in error are counted, and left out of everything else.

    Args:
        weights: of the reward.
    """
    policies = list(dict.fromkeys(row.policy for row in rows))
    shown = _best(rows, policies, MOST_POLICIES)
    console.print(_overall(rows, shown, share_best(rows, policies, weights), weights))
    if len(shown) < len(policies):
        console.print(f"and {len(policies) - len(shown)} more policies that succeed less often")
    split = _split(rows, _best(rows, policies, _MOST_COLUMNS))
    if split.row_count:
        console.print(split)


def share_best(rows: Sequence[Row], policies: Sequence[str], weights: RewardWeights) -> dict[str, float]:
    """Share of the instances on which each policy has the highest mean reward over its repeats; policies that come to the same share an instance.

    Only instances on which every policy has a valid outcome count; empty where there are none, such as where prices are not known.
    """
    values = row_rewards(rows, weights)
    numbers: dict[str, int] = {}
    places = [(numbers.setdefault(row.instance, len(numbers)), policies.index(row.policy)) for row in rows]
    sums, counts = np.zeros((len(numbers), len(policies))), np.zeros((len(numbers), len(policies)))
    for place, value in zip(places, values, strict=True):
        if np.isfinite(value):
            sums[place] += value
            counts[place] += 1
    complete = (counts > 0).all(axis=1)
    shares = share_of_best(sums[complete] / counts[complete])
    return dict(zip(policies, shares.tolist(), strict=True)) if complete.any() else {}


def _best(rows: Sequence[Row], policies: Sequence[str], most: int) -> Sequence[str]:
    """The policies that succeed most often, in their order, where there are more than so many."""
    if len(policies) <= most:
        return policies
    successes: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        if row.error is None:
            successes[row.policy].append(credited(row, "success"))
    best = set(sorted(policies, key=lambda policy: -float(np.mean(successes[policy] or [0.0])))[:most])
    return [policy for policy in policies if policy in best]


def _overall(rows: Sequence[Row], policies: Sequence[str], best: Mapping[str, float], weights: RewardWeights) -> Table:
    instances = len({row.instance for row in rows})
    tasks = {row.task: None for row in rows}
    title = f"{len(tasks)} tasks" if len(tasks) > 1 else next(iter(tasks), "")
    optional = {name: (heading, digits) for name, (heading, digits) in _MEASURES.items() if any(getattr(row, name) is not None for row in rows)}
    seconds, rewards = row_seconds(rows), row_rewards(rows, weights)
    timed = bool(np.isfinite(seconds).any())
    headings = ["episodes", "success [95%]", *(heading for heading, _ in optional.values()), *(["seconds"] if timed else [])]
    headings += ["mean reward", "best on", "fallbacks", "solved by them", "errors"]
    table = Table(f"{title}: {instances} instances, {len(rows)} episodes", ["policy"], headings)
    for policy in policies:
        own = [row for row in rows if row.policy == policy]
        valid = [row for row in own if row.error is None]
        counted = np.array([row.policy == policy and row.error is None for row in rows])
        on = [row.instance for row in valid]
        measured = [number(_mean([getattr(row, name) for row in valid], on), digits) for name, (_, digits) in optional.items()]
        table.add(
            policy,
            str(len(own)),
            _rate(valid),
            *measured,
            *([number(_mean(seconds[counted], on))] if timed else []),
            number(_mean(rewards[counted], on), 3),
            percent(best.get(policy)),
            str(sum(row.fallback is not None for row in own)),
            str(sum(row.fallback is not None and row.success for row in valid)),
            str(len(own) - len(valid)),
        )
    return table


_MEASURES = {"subgoals": ("subgoals", 2), "score": ("score", 4), "steps": ("steps", 1), "price": ("price (cents)", 3)}
"""Columns of the log that a log from elsewhere may lack: their headings and digits."""


def _split(rows: Sequence[Row], policies: Sequence[str]) -> Table:
    table = Table("success [95%] by kind of instance", ["by", ""], ["instances", *policies])
    kinds: dict[str, int] = {}
    for name, key in SPLITS.items():
        parts: dict[str, list[Row]] = defaultdict(list)
        for row in rows:
            value = key(row)
            if value is not None:
                parts[value].append(row)
        kinds[name] = len(parts)
        if name in ("task", "robot", "level") and len(parts) == 1:
            continue  # all the same
        if name == "task at level" and 1 in (kinds["task"], kinds["level"]):
            continue  # shown already
        for value, part in sorted(parts.items()):
            rates = [_rate([row for row in part if row.policy == policy and row.error is None]) for policy in policies]
            table.add(name, value, str(len({row.instance for row in part})), *rates)
        table.add_section()
    return table


def _rate(valid: Sequence[Row]) -> str:
    if not valid:
        return "-"
    by_instance: dict[str, list[float]] = defaultdict(list)
    for row in valid:
        by_instance[row.instance].append(credited(row, "success"))
    rates = [float(np.mean(successes)) for successes in by_instance.values()]
    rate, trials = float(np.mean(rates)), effective_trials(rates, len(valid))
    return percent(rate, wilson_interval(min(rate * trials, trials), trials))


def _mean(values: ArrayLike, instances: Sequence[str]) -> float | None:
    """Mean over instances (n,) of the means of what is known of each, neither None nor NaN: as the page has it, whatever the repeats."""
    numbers = np.asarray(values, np.float64)
    known = np.isfinite(numbers)
    if not known.any():
        return None
    _, at = np.unique(np.asarray(instances)[known], return_inverse=True)
    return float((np.bincount(at, numbers[known]) / np.bincount(at)).mean())
