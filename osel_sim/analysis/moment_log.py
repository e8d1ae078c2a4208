"""A table of moments as arrays: what became of every episode, had another policy taken over at one of its decision points."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, LoggedOutcomes, read_log
from osel_sim.core.errors import DataError
from osel_sim.formats.moments import MOMENTS, MomentRow, Seen, read_moments
from osel_sim.interface.outcome import credited
from osel_sim.selection.reward import RewardWeights, combined, counted_time, total_seconds

KEPT = ("success", "subgoals", "steps", "seconds", "price", "remote_steps")
"""Measures of an episode, whoever drove."""


@dataclass(frozen=True)
class MomentLog:
    """N instances, P policies, R repeats, M decision points. What is not there is NaN: an error, or an episode that was over before the point.

    The last axis is the policy that drives from the point on; the first policy's own place there says how its episode went on without a handoff.

    Attributes:
        whole: the episodes without a handoff, and the contexts of their beginnings.
        calls: (M,) calls before each decision point.
        ways: measure of `KEPT` -> (N, P, R, M, P).
        at_step: control steps before each decision point, (N, P, R, M).
        seen_at: row of `seen` of each decision point, (N, P, R, M); -1 where the episode was over.
        seen: what was to be seen.
        remote: (P,) which policies are remote.
        metadata: of the table.
    """

    whole: LoggedOutcomes
    calls: tuple[int, ...]
    ways: Mapping[str, Array]
    at_step: Array
    seen_at: NDArray[np.int64]
    seen: Seen
    remote: NDArray[np.bool_]
    metadata: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.whole)

    @property
    def policies(self) -> tuple[str, ...]:
        """Names, (P,)."""
        return self.whole.policies

    @property
    def there(self) -> NDArray[np.bool_]:
        """Which decision points there are, (N, P, R, M)."""
        return self.seen_at >= 0

    @cached_property
    def alone(self) -> dict[str, Array]:
        """Measure of `KEPT` -> (N, P, R): of each first policy without a handoff."""
        whole = self.whole
        own = {"success": whole.success, "subgoals": whole.subgoals, "steps": whole.steps, "seconds": whole.seconds, "price": whole.price}
        # Where a remote policy's fallback drove, the recording has it in the table only; the log says how many steps those were not.
        remote = np.where(self.remote[None, :, None], whole.steps, 0.0)
        first = np.arange(len(self.policies))
        if self.calls:
            told = self.ways["remote_steps"][:, first, :, 0, first].transpose(1, 0, 2)
            remote = np.where(np.isfinite(told), told, remote)
        return own | {"remote_steps": np.where(np.isfinite(whole.success), remote, np.nan)}

    def rewards(self, weights: RewardWeights) -> Array:
        """Reward of every way on, (N, P, R, M, P)."""
        return rewards_of(self.ways, weights)

    def take(self, rows: NDArray[Any]) -> "MomentLog":
        """Only these instances: indices, or a bool array (N,)."""
        index = np.flatnonzero(rows) if rows.dtype == bool else rows.astype(np.int64)
        ways = {name: values[index] for name, values in self.ways.items()}
        return replace(self, whole=self.whole.take(index), ways=ways, at_step=self.at_step[index], seen_at=self.seen_at[index])

    def only(self, policies: "tuple[str, ...]") -> "MomentLog":
        """Only these policies, as first and as second.

        Raises:
            UnknownNameError, UsageError: as `LoggedOutcomes.only`.
        """
        whole = self.whole.only(policies)
        at = np.array([self.policies.index(name) for name in policies])
        ways = {name: values[:, at][..., at] for name, values in self.ways.items()}
        return replace(self, whole=whole, ways=ways, at_step=self.at_step[:, at], seen_at=self.seen_at[:, at], remote=self.remote[at])


def rewards_of(measures: Mapping[str, Array], weights: RewardWeights) -> Array:
    """Rewards of measures as `KEPT` names them, in their shape."""
    time = counted_time(weights, measures["steps"], measures["seconds"])
    return combined(weights, measures["subgoals" if weights.success == "subgoals" else "success"], time, measures["price"])


def read_moment_log(folder: Path, encoder: str | None = None) -> MomentLog:
    """Read a rollout log and the table of moments beside it.

    Raises:
        DataError: one of them is missing or damaged, or they are not of the same episodes.
    """
    table, whole = read_moments(folder), read_log(folder, encoder)
    policies, repeats = whole.policies, whole.repeats
    calls = tuple(sorted({row.call for row in table.rows}))
    shape = (len(whole), len(policies), repeats, len(calls))
    ways = {name: np.full((*shape, len(policies)), np.nan) for name in KEPT}
    at_step, seen_at = np.full(shape, np.nan), np.full(shape, -1, np.int64)
    instances, numbers = {key: number for number, key in enumerate(whole.keys)}, dict[tuple[str, str, int, int], int]()
    for row in table.rows:
        place = _place(row, instances, policies, repeats, calls, folder)
        seen_at[place], at_step[place] = numbers.setdefault(row.moment, len(numbers)), row.step
        if row.error is None:
            second = policies.index(row.second or row.first)
            for name, value in _measures(row).items():
                ways[name][(*place, second)] = value
    remote = np.array([name in table.metadata["remote"] for name in policies])
    log = MomentLog(whole, calls, ways, at_step, seen_at, table.seen, remote, table.metadata)
    _check_going_on(log, folder)
    return log


def _place(
    row: MomentRow, instances: Mapping[str, int], policies: tuple[str, ...], repeats: int, calls: tuple[int, ...], folder: Path
) -> tuple[int, int, int, int]:
    if row.instance not in instances or row.first not in policies or row.repeat >= repeats:
        raise DataError(f"{folder / MOMENTS}: {row.instance!r}, {row.first!r}, repeat {row.repeat} is no episode of the rollout log beside it")
    return instances[row.instance], policies.index(row.first), row.repeat, calls.index(row.call)


def _measures(row: MomentRow) -> dict[str, float]:
    seconds = float(total_seconds(row.upload, row.inference, row.download, row.motion))
    own = {"success": credited(row, "success"), "subgoals": credited(row, "subgoals")}
    return own | {"steps": row.steps, "seconds": seconds, "price": row.price, "remote_steps": row.remote_steps}


def _check_going_on(log: MomentLog, folder: Path) -> None:
    """Refuse a table whose episodes without a handoff are not those of the rollout log."""
    first = np.arange(len(log.policies))
    for name in ("success", "steps", "price"):
        going_on = log.ways[name][:, first, :, :, first].transpose(1, 0, 2, 3)
        wrong = np.isfinite(going_on) & ~np.isclose(going_on, log.alone[name][..., None])
        if wrong.any():
            row, column, repeat, at = (int(index) for index in np.argwhere(wrong)[0])
            raise DataError(
                f"{folder / MOMENTS}: instance {log.whole.keys[row]!r}, {log.policies[column]!r}, repeat {repeat}, call {log.calls[at]}: "
                f"{name} of going on is {going_on[row, column, repeat, at]:g}, in the rollout log beside it {log.alone[name][row, column, repeat]:g}"
            )
