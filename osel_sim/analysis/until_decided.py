"""When a recording may stop: after every few instances one looks whether the answer is there, with bounds that hold however often one looks.

Instances are recorded in rounds of a few seeds of all tasks, with all levels alike often, and looked at after whole rounds. So what is bounded at a
look is the mean over tasks and levels alike, whatever their order.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import LoggedOutcomes, mean_over_repeats
from osel_sim.core.errors import DataError, UsageError
from osel_sim.episodes.workers import KEPT_OPEN, Episode, Plan
from osel_sim.formats.rollout_log import Row
from osel_sim.formats.toml_types import quoted
from osel_sim.interface.outcome import credited
from osel_sim.statistics.intervals import Interval
from osel_sim.statistics.sequential import anytime_bounds

ERROR = 0.05
"""Probability of a wrong answer, all pairs of policies together: half of it on each side."""
FEWEST = 10
"""With fewer pairs nothing is claimed, and so many instances at least lie between two looks."""
SEEDS_AN_OPENING = 4
"""Seeds of a task in a round, where it is opened anew in each."""
UNTIL_DECIDED = "until_decided"
"""Key in a log's metadata of how it was stopped: `margin`, `seeds_a_look`, `policies`, and of a baseline `baseline_policy` and `baseline_sha256`."""


def answered(bounds: Interval, pairs: int, margin: float) -> bool:
    """Whether bounds on a difference of success tell: no worse by the margin (which better is), or worse."""
    return pairs >= FEWEST and (bounds[0] > -margin or bounds[1] < 0.0)


def seeds_a_look(tasks: int, levels: int) -> int:
    """Seeds between two looks: the fewest that make `FEWEST` instances or more, all levels alike often.

    Of many tasks, which a worker cannot all keep open, so many that opening each once a round does not cost more than its episodes.
    """
    seeds = max(FEWEST / tasks, SEEDS_AN_OPENING if tasks > KEPT_OPEN else 1)
    return levels * math.ceil(seeds / levels)


def looks_of(metadata: Mapping[str, Any], place: str) -> tuple[int, int] | None:
    """First seed and seeds a look of a log that was recorded until it was decided; None of another.

    Raises:
        DataError: its metadata do not have the promised form.
    """
    told = metadata.get(UNTIL_DECIDED)
    if told is None:
        return None
    start, every = metadata.get("start_seed"), told.get("seeds_a_look") if isinstance(told, dict) else None
    if type(start) is not int or type(every) is not int or every < 1 or start < 0:
        raise DataError(f"{place}: {UNTIL_DECIDED} in its metadata must have seeds_a_look, an integer of 1 or more, got {quoted(told)}")
    return start, every


class UntilDecided:
    """Looks at what has been recorded, round after round.

    Args:
        policies: of the plan, which are compared with one another.
        margin: how much lower a rate of success may be to count as no worse.
        baseline: a log and the policy of it which the others are compared with as well.

    Attributes:
        order: keys of the plan's instances as they are to be recorded.
        kept: keys of those up to the look at which every pair of policies had its answer; None until then.

    Raises:
        UsageError: the baseline lacks instances of the plan.
    """

    def __init__(self, plan: Plan, policies: Sequence[str], margin: float, baseline: tuple[LoggedOutcomes, str] | None = None) -> None:
        self._plan, self._policies, self._margin = plan, tuple(policies), margin
        every = seeds_a_look(len(plan.tasks), len(set(plan.levels)))
        rounds: dict[int, list[str]] = {}
        for key, instance in plan.instances.items():  # task by task, within a round as well
            rounds.setdefault((instance.seed - plan.seeds.start) // every, []).append(key)
        self._rounds = [rounds[number] for number in sorted(rounds)]
        self.order = [key for keys in self._rounds for key in keys]
        self._baseline = None if baseline is None else _Baseline(*baseline, self.order)
        self.kept: frozenset[str] | None = None
        names = ([""] if baseline is not None else []) + list(policies)
        self._differences: dict[tuple[str, str], list[float]] = {pair: [] for pair in combinations(names, 2)}
        self._ends: dict[tuple[str, str], list[int]] = {pair: [] for pair in self._differences}
        self._looked = 0

    @property
    def pairs(self) -> int:
        """Pairs of policies that need an answer."""
        return len(self._differences)

    def look(self, rows: Mapping[str, Mapping[Episode, Row]]) -> bool:
        """Look at all rounds that are complete now. Returns whether the answer is there, so that nothing else need be recorded.

        Args:
            rows: instance -> its episodes.

        Raises:
            DataError: an instance has another scene than in the baseline's log.
        """
        while self.kept is None and self._looked < len(self._rounds) and all(self._complete(key, rows) for key in self._rounds[self._looked]):
            for key in self._rounds[self._looked]:
                self._take(key, rows[key])
            self._looked += 1
            if self._decided():
                self.kept = frozenset(key for keys in self._rounds[: self._looked] for key in keys)
        return self.kept is not None

    def _complete(self, key: str, rows: Mapping[str, Mapping[Episode, Row]]) -> bool:
        there = rows.get(key, {})
        return all(episode in there for episode in self._plan.episodes(key) if episode[0] in self._policies)

    def _take(self, key: str, episodes: Mapping[Episode, Row]) -> None:
        values = {policy: _mean_success(policy, episodes) for policy in self._policies}
        if self._baseline is not None:
            values[""] = self._baseline.success(key, episodes.values())
        for (one, other), differences in self._differences.items():
            if math.isfinite(difference := values[other] - values[one]):
                differences.append(difference)

    def _decided(self) -> bool:
        found = []
        for pair, differences in self._differences.items():
            self._ends[pair].append(len(differences))
            bounds = anytime_bounds(differences, self._ends[pair], ERROR / 2.0 / self.pairs)[-1]
            found.append(answered(bounds, len(differences), self._margin))
        return all(found)


class _Baseline:
    """What a policy of another log came to."""

    def __init__(self, log: LoggedOutcomes, policy: str, wanted: Sequence[str]) -> None:
        self._log, self._row = log, {key: row for row, key in enumerate(log.keys)}
        self._values: NDArray[np.float64] = mean_over_repeats(log.only([policy]).success)[:, 0]
        missing = [key for key in wanted if key not in self._row]
        if missing:
            raise UsageError(
                f"--baseline {log.source} lacks {len(missing)} of the {len(wanted)} instances, such as {quoted(missing[0])}: "
                "leave --task and --instances out, and its own are taken"
            )

    def success(self, key: str, episodes: Any) -> float:
        """Its rate of success on an instance, NaN where there is no outcome."""
        row = self._row[key]
        then = self._log.instances[row].scene
        if any(None not in (now.scene, then) and now.scene != then for now in episodes):
            raise DataError(
                f"instance {quoted(key)} is not the same scene as in the baseline {self._log.source}: "
                "assets, tasks or versions of the simulator differ. Record the baseline anew"
            )
        return float(self._values[row])


def _mean_success(policy: str, episodes: Mapping[Episode, Row]) -> float:
    """Mean over the repeats that have an outcome, NaN where none has."""
    values = [credited(row, "success") for (name, _), row in episodes.items() if name == policy and row.error is None]
    return sum(values) / len(values) if values else math.nan
