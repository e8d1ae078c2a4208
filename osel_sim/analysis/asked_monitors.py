"""Monitors that run live, asked at the decision points of a table of moments: what they would have said, and what they learn from the ways on.

A monitor is shown what it would have been shown: the point's numbers, its picture and the change of its image. One that asks a policy for a second
opinion changes the episode by that (the robot waits, and the call is paid), so that no table can have it; it is refused.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.cross_fit import Rows
from osel_sim.analysis.handovers import driving_on
from osel_sim.analysis.moment_log import MomentLog
from osel_sim.formats.moments import SIGNALS
from osel_sim.interface.monitor import Candidate, DecisionPoint, Monitor, Told, Turn, Watched
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.selection.monitors.registry import make_monitor
from osel_sim.selection.reward import RewardWeights, charge, counted_time

FOLDS = 2
"""In so many parts the instances that are learned from are themselves decided on, each by what was learned from the others."""


def asked_turns(log: MomentLog, weights: RewardWeights, name: str, by: Rows, on: Rows) -> NDArray[np.int64]:
    """Who drives on at each decision point by a monitor, (N, P, R, M), as `osel_sim.analysis.handovers.first_turns` takes them.

    Args:
        name: as `--monitor` takes it, such as `stall` or `blind:8:remote_large`.
        by: (N,) instances whose ways on it is shown beforehand, each as an episode.
        on: (N,) instances that it decides on; of those `by` it says what it does after it was shown the others of them. The rest drives on.

    Raises:
        UnknownNameError, UsageError: no such monitor, or it does not take these parameters.
        DataError: it looks at what the table does not have.
    """
    turns = driving_on(log)
    fold = np.random.default_rng(0).permutation(int(by.sum())) % FOLDS
    for number in range(FOLDS):
        inside, outside = by.copy(), by.copy()
        inside[by], outside[by] = fold != number, fold == number
        _ask(log, weights, name, inside, outside, turns)
    _ask(log, weights, name, by, on, turns)
    return turns


def _ask(log: MomentLog, weights: RewardWeights, name: str, by: Rows, on: Rows, turns: NDArray[np.int64]) -> None:
    """Fill in the turns of the instances `on`."""
    candidates = [Candidate(policy, bool(remote)) for policy, remote in zip(log.policies, log.remote, strict=True)]
    monitor = make_monitor(name, candidates, log.seen.pictures.shape[1], seed=0)
    show_ways(log, weights, monitor, by)
    for row in np.flatnonzero(on):
        instruction = log.whole.instances[row].instruction or ""
        for first, driver in enumerate(log.policies):
            for repeat in range(log.whole.repeats):
                monitor.reset(instruction, driver, (int(row), first, repeat))
                for at in np.flatnonzero(log.there[row, first, repeat]):
                    place = int(row), first, repeat, int(at)
                    turn = monitor.drives_on(_point(log, place))
                    turn.check(log.policies)
                    turns[place] = log.policies.index(turn.policy)
                    if turn.policy != driver:
                        break  # what would come after a handoff is not known


def show_ways(log: MomentLog, weights: RewardWeights, monitor: Monitor, by: Rows) -> None:
    """Let a monitor learn from every way on of these instances, in a random order, each as an episode with that one decision point."""
    rewards = log.rewards(weights)
    known = np.argwhere(np.isfinite(rewards) & by[:, None, None, None, None])
    for row, first, repeat, at, second in np.random.default_rng(0).permutation(known).tolist():
        point = _point(log, (row, first, repeat, at))
        reward = float(rewards[row, first, repeat, at, second])
        so_far = float(charge(weights, counted_time(weights, point.step, point.seconds), point.price))
        outcome = _outcome(log, (row, first, repeat, at, second))
        monitor.learn(Watched([point], [Turn(log.policies[second])], outcome, reward, [reward + so_far]))


def _point(log: MomentLog, place: tuple[int, int, int, int]) -> DecisionPoint:
    row, first, _, at = place
    number = log.seen_at[place]
    told: dict[str, Any] = {name: None if np.isnan(value) else float(value) for name, value in zip(SIGNALS, log.seen.signals[number], strict=True)}
    change = told.pop("change")
    look = Told(log.seen.pictures[number], (change,))
    about = {"call": log.calls[at], "step": int(log.at_step[place]), "driver": log.policies[first]}
    return DecisionPoint(**about, **told, instruction=log.whole.instances[row].instruction or "", look=look)  # type: ignore[arg-type]


def _outcome(log: MomentLog, way: Sequence[int]) -> Outcome:
    """What came of a way on, as far as the table's arrays have it."""
    success, subgoals, steps, seconds, price = (float(log.ways[name][tuple(way)]) for name in ("success", "subgoals", "steps", "seconds", "price"))
    return Outcome(success > 0.5, subgoals, int(steps), Seconds(motion=seconds), 0, 0, price)
