"""What is to be gained by handing over within an episode, at most and by whom: oracles of when, and gains by moment.

A schedule is a first policy, and either nothing more or a decision point and a second policy; an episode that is over before the point goes by what
it came to. The *oracle of when* takes for each instance the schedule that was best in all its repeats but one, and is scored on that one, in turn;
the *oracle of choosing once* likewise, of the schedules without a handover. One or two repeats say little, so that the other instances of the task
count as two repeats more. Both need repeats, count no luck as foresight, and with few repeats find less than there is. *In hindsight* chooses and
scores on the same repeat.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.estimate import Estimate, mean_of
from osel_sim.analysis.learned_handovers import gains_of
from osel_sim.analysis.log import Array, mean_over_repeats
from osel_sim.analysis.moment_log import MomentLog, rewards_of
from osel_sim.selection.reward import RewardWeights

Schedule = tuple[int, int, int]
"""Columns of the first policy, of the decision point and of the second policy; -1 and -1 where the first drives to the end."""

TASK = 2.0
"""So many repeats the other instances of the task count as, where the best schedule of an instance is chosen."""


def schedules(log: MomentLog) -> list[Schedule]:
    """All there are, those without a handover first."""
    policies, points = range(len(log.policies)), range(len(log.calls))
    once = [(first, -1, -1) for first in policies]
    return once + [(first, at, second) for first in policies for at in points for second in policies if second != first]


def schedule_rewards(log: MomentLog, weights: RewardWeights) -> Array:
    """Reward of each schedule on each repeat of each instance, (N, R, number of schedules)."""
    alone, ways = rewards_of(log.alone, weights), log.rewards(weights)
    columns = []
    for first, at, second in schedules(log):
        own = alone[:, first]
        columns.append(own if at < 0 else np.where(log.there[:, first, :, at], ways[:, first, :, at, second], own))
    return np.stack(columns, axis=2)


@dataclass(frozen=True)
class Oracles:
    """Rewards of the oracles on the instances that have repeats.

    Attributes:
        repeated: (N,) which those are.
        once, when: (N,) NaN where an instance has no repeats.
        hindsight_once, hindsight_when: (N,).
        chosen: how often `when` takes each schedule.
    """

    repeated: NDArray[np.bool_]
    once: Array
    when: Array
    hindsight_once: Array
    hindsight_when: Array
    chosen: dict[Schedule, int]


def oracles_of(log: MomentLog, weights: RewardWeights) -> Oracles:
    """The oracles of a table."""
    rewards, names = schedule_rewards(log, weights), schedules(log)
    whole = np.isfinite(rewards).all(axis=2)
    repeated = whole.sum(axis=1) >= 2
    found = {name: np.full(len(log), np.nan) for name in ("once", "when")}
    chosen: dict[Schedule, int] = {}
    order = np.argsort(-np.nanmean(rewards, axis=(0, 1)), kind="stable")  # of schedules that are equal on an instance, the one that is best of all
    tasks = np.array(log.whole.labels("task"))
    means = mean_over_repeats(rewards.transpose(0, 2, 1))
    means = np.where(np.isfinite(means), means, np.nanmean(means, axis=0))
    singles = np.array([names[column][1] < 0 for column in order])
    for row in np.flatnonzero(repeated):
        own = rewards[row][whole[row]][:, order]
        others = (tasks == tasks[row]) & (np.arange(len(log)) != row)
        prior = means[others if others.any() else np.arange(len(log)) != row][:, order].mean(axis=0)
        rest = (own.sum(axis=0) - own + TASK * prior) / (len(own) - 1 + TASK)
        for name, allowed in (("once", singles), ("when", np.ones_like(singles))):
            best = np.where(allowed, rest, -np.inf).argmax(axis=1)
            found[name][row] = own[np.arange(len(own)), best].mean()
            for column in best if name == "when" else ():
                chosen[names[order[column]]] = chosen.get(names[order[column]], 0) + 1
    once = np.array([schedule[1] < 0 for schedule in names])
    hindsight_once, hindsight_when = (mean_over_repeats(part.max(axis=2)) for part in (rewards[:, :, once], rewards))
    return Oracles(repeated, found["once"], found["when"], hindsight_once, hindsight_when, chosen)


@dataclass(frozen=True)
class GainAt:
    """What a handover at a decision point gains over going on, from the same states.

    Attributes:
        moments: on which instances it was measured.
        gain: in reward.
        recovered, harmed: shares of what going on would have lost that is won, and of what it would have won that is lost; None of nothing.
    """

    task: str
    first: str
    second: str
    call: int
    moments: int
    gain: Estimate
    recovered: float | None
    harmed: float | None


def gains_at(log: MomentLog, weights: RewardWeights, units: NDArray[np.int64]) -> list[GainAt]:
    """Of every task, first and second policy and decision point that has instances; `all` for all tasks together."""
    gains, tasks = gains_of(log, weights), np.array(log.whole.labels("task"))
    result = []
    for task in ("all", *sorted(set(tasks.tolist()))):
        rows = np.ones(len(log), bool) if task == "all" else tasks == task
        for first, at, second in schedules(log):
            if at < 0:
                continue
            won = log.ways["success"][rows, first, :, at]
            gain = mean_of(mean_over_repeats(gains[rows, first, :, at, second]), units[rows])
            if gain is None:
                continue
            known = np.isfinite(won[..., first]) & np.isfinite(won[..., second])
            before, then = won[..., first][known], won[..., second][known]
            recovered = float(then[before < 0.5].mean()) if (before < 0.5).any() else None
            harm = float(1.0 - then[before > 0.5].mean()) if (before > 0.5).any() else None
            moments = int(np.isfinite(gains[rows, first, :, at, second]).any(axis=1).sum())
            names = log.policies
            result.append(GainAt(task, names[first], names[second], log.calls[at], moments, gain, recovered, harm))
    return result
