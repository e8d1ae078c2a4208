"""Policies side by side on the same instances: what each came to where both have a valid outcome, and what has no counterpart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from osel_sim.analysis.live import is_live_run, read_live
from osel_sim.analysis.log import Array, LoggedInstance, LoggedOutcomes, mean_over_repeats, read_outcomes
from osel_sim.analysis.until_decided import looks_of
from osel_sim.core.errors import DataError
from osel_sim.formats.toml_types import quoted
from osel_sim.interface.robot import DEFAULT_ROBOT
from osel_sim.selection.reward import RewardWeights

MEASURES = ("success", "subgoals", "score", "reward", "steps", "seconds", "price")
"""What is compared, where a log has it; price in cents."""
_ABOUT = ("task", "instruction", "phrasing", "target", "container", "seed", "level", "split")


@dataclass(frozen=True)
class Contender:
    """One policy of one log.

    Attributes:
        name: what it is called beside the others; with the log's folder where two have the same policy.
        policy: its name in the log.
    """

    name: str
    policy: str
    log: LoggedOutcomes

    def values(self, weights: RewardWeights) -> tuple[dict[str, Array], dict[str, str]]:
        """Each measure as its mean over repeats, (N,), NaN where there is none; and why the reward is missing, if it is."""
        log, missing = self.log.only([self.policy]), dict[str, str]()
        tables = {name: log.seconds if name == "seconds" else getattr(log, name) for name in MEASURES if name != "reward"}
        try:
            tables["reward"] = log.rewards(weights)
        except DataError as error:
            missing["reward"] = str(error)
        return {name: mean_over_repeats(table)[:, 0] for name, table in tables.items()}, missing


@dataclass(frozen=True)
class Looks:
    """When a log that was recorded until it was decided was looked at.

    Attributes:
        order: (n,) rows of the pairs as they came.
        ends: (looks,) how many pairs there were at each.
    """

    order: tuple[int, ...]
    ends: tuple[int, ...]


@dataclass(frozen=True)
class Pairs:
    """Two contenders on the n instances on which both have a valid outcome.

    Attributes:
        keys, tasks: (n,) of the instances, in the order of the first's log.
        first_values, second_values: measure -> (n,) mean over an instance's repeats; NaN where unknown.
        repeats: pairs of repeats, n where nothing was repeated.
        only_first, only_second: instances on which only that one has a valid outcome.
        errors: episodes of either that ended in error, on whatever instance.
        missing: measure -> why there is none.
        scenes: pairs of which both logs tell that the scene is the same; of the others only the keys say so.
        looks: where one of the logs was recorded until it was decided; None: the number of instances was fixed.
    """

    first: Contender
    second: Contender
    keys: tuple[str, ...]
    tasks: tuple[str, ...]
    first_values: Mapping[str, Array]
    second_values: Mapping[str, Array]
    repeats: int
    only_first: int
    only_second: int
    errors: tuple[int, int]
    missing: Mapping[str, str]
    scenes: int = 0
    looks: Looks | None = None

    def differences(self, measure: str = "success") -> Array:
        """The second's value minus the first's, (n,); NaN where one is unknown."""
        return self.second_values[measure] - self.first_values[measure]


def read_contender_log(folder: Path) -> LoggedOutcomes:
    """A rollout log, of which contexts are not needed, or a live run: what it chose, and with `--counterfactual` all outcomes."""
    return read_live(folder).outcomes if is_live_run(folder) else read_outcomes(folder)


def pair(first: Contender, second: Contender, weights: RewardWeights) -> Pairs:
    """Pair two contenders by the instances' keys.

    Raises:
        DataError: no instance has a valid outcome of both, or the logs tell different things of an instance, its scene, its task file or the noise.
    """
    if first.log is not second.log:
        check_same_conditions((first.log.source, first.log.metadata), (second.log.source, second.log.metadata))
    (values_first, missing_first), (values_second, missing_second) = first.values(weights), second.values(weights)
    values = values_first, values_second
    at = [
        {key: row for row, key in enumerate(one.log.keys) if np.isfinite(own["success"][row])}
        for one, own in zip((first, second), values, strict=True)
    ]
    keys = [key for key in at[0] if key in at[1]]
    if not keys:
        raise DataError(
            f"{first.name} and {second.name} have no instance in common on which both have an outcome, so nothing can be paired: "
            f"{_some(first, at[0])}; {_some(second, at[1])}. Record both with the same tasks, levels, split and seeds"
        )
    rows = [[positions[key] for key in keys] for positions in at]
    if first.log is not second.log:
        for key, one, other in zip(keys, *rows, strict=True):
            _check_same_instance(key, (first.log, one), (second.log, other))
        _check_same_scenes(first.log, second.log, rows)
    counts = [np.isfinite(one.log.only([one.policy]).success[own, 0]).sum(axis=1) for one, own in zip((first, second), rows, strict=True)]
    known = [name for name in MEASURES if all(name in own for own in values)]
    return Pairs(
        first,
        second,
        tuple(keys),
        tuple(first.log.instances[row].task for row in rows[0]),
        {name: values[0][name][rows[0]] for name in known},
        {name: values[1][name][rows[1]] for name in known},
        int(np.minimum(*counts).sum()),
        len(at[0]) - len(keys),
        len(at[1]) - len(keys),
        (_errors(first), _errors(second)),
        missing_first | missing_second,
        sum(None not in scenes for scenes in _scenes(first.log, second.log, rows)),
        _looks([first.log, second.log], rows),
    )


def _errors(contender: Contender) -> int:
    return int(contender.log.only([contender.policy]).errors.sum())


def _some(contender: Contender, keys: Mapping[str, int]) -> str:
    return f"{contender.name} has {len(keys)}" + (f", such as {quoted(next(iter(keys)))}" if keys else "")


def check_same_conditions(one: tuple[Path, Mapping[str, Any]], other: tuple[Path, Mapping[str, Any]]) -> None:
    """Refuse logs, each its folder and metadata, whose scenes or actions were made differently, as far as the metadata say.

    Raises:
        DataError: naming what differs.
    """
    (here, _), (there, _) = one, other
    contents = [metadata.get("content") or {} for _, metadata in (one, other)]
    for name in sorted(set(contents[0]) & set(contents[1])):
        if name.startswith("task ") and contents[0][name] != contents[1][name]:
            raise DataError(f"{name} is another file in {there} than in {here}: scenes of one seed may differ, so they are no pairs")
    noises = [metadata.get("action_noise") for _, metadata in (one, other)]
    if None not in noises and noises[0] != noises[1]:
        raise DataError(f"action_noise is {noises[0]} in {here} and {noises[1]} in {there}: record both with the same --action-noise")


def _check_same_instance(key: str, one: tuple[LoggedOutcomes, int], other: tuple[LoggedOutcomes, int]) -> None:
    """Refuse a pair of which the logs tell different things; what one of them does not know does not count."""
    here, there = (log.instances[row] for log, row in (one, other))
    for name in (*_ABOUT, "robot"):
        was, now = _told(here, name), _told(there, name)
        if was is not None and now is not None and was != now:
            there_is, here_is = (f"{quoted(value)} in {log.source}" for value, (log, _) in ((now, other), (was, one)))
            raise DataError(f"instance {quoted(key)} is not the same in both logs: its {name} is {here_is}, {there_is}")


def _looks(logs: Sequence[LoggedOutcomes], rows: Sequence[Sequence[int]]) -> Looks | None:
    """When the pairs were looked at, if one of the logs was stopped by what it showed; of two such, as the second was."""
    told = [(log, own, found) for log, own in zip(logs, rows, strict=True) if (found := looks_of(log.metadata, str(log.source))) is not None]
    if not told:
        return None
    log, own, (start, every) = told[-1]
    seeds = [log.instances[row].seed for row in own]
    if any(seed is None or seed < start for seed in seeds):
        raise DataError(f"{log.source}: its metadata say that it was recorded until it was decided, but some of its instances have other seeds")
    rounds = np.array([((seed or 0) - start) // every for seed in seeds])
    order = np.argsort(rounds, kind="stable")
    ends = np.searchsorted(rounds[order], np.arange(int(rounds.max()) + 1), side="right")
    return Looks(tuple(order.tolist()), tuple(ends.tolist()))


def _scenes(one: LoggedOutcomes, other: LoggedOutcomes, rows: Sequence[Sequence[int]]) -> list[tuple[str | None, str | None]]:
    """What both logs tell of the scene of each pair."""
    return [(one.instances[here].scene, other.instances[there].scene) for here, there in zip(*rows, strict=True)]


def _check_same_scenes(one: LoggedOutcomes, other: LoggedOutcomes, rows: Sequence[Sequence[int]]) -> None:
    """Refuse pairs whose scenes were not set up alike."""
    differ = [row for row, scenes in enumerate(_scenes(one, other, rows)) if None not in scenes and scenes[0] != scenes[1]]
    if differ:
        key = one.keys[rows[0][differ[0]]]
        raise DataError(
            f"instance {quoted(key)} is not the same scene in {one.source} and in {other.source}"
            + (f", nor are {len(differ) - 1} others of {len(rows[0])}" if len(differ) > 1 else "")
            + ": assets, tasks or versions of the simulator differ. Record both with the same installation"
        )


def _told(instance: LoggedInstance, name: str) -> Any:
    value = getattr(instance, name)
    return DEFAULT_ROBOT if name == "robot" and value is None and instance.seed is not None else value
