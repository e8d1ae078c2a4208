"""Whether routing is worth it on a log or a run that nobody replayed: the verdict of a replay of the recommended selector."""

from copy import deepcopy
from typing import Any

from osel_sim.analysis.engine import Setup, replay
from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.oracles import oracles
from osel_sim.analysis.remembered import Remembered
from osel_sim.analysis.result import build, with_fixed
from osel_sim.analysis.streams import complete_instances
from osel_sim.analysis.told import told
from osel_sim.core.errors import DataError
from osel_sim.selection.registry import RECOMMENDED
from osel_sim.selection.reward import RewardWeights

SEEDS = 20
"""Orders, as many as a replay has where nothing else is said: on the same data the two say the same."""

BUDGET = 24_000
"""Decisions, some twenty seconds; of a log of more than 1,200 instances fewer orders are replayed, of one of more than 12,000 shorter ones."""


_remembered = Remembered[dict[str, Any] | None]()


def answer(log: LoggedOutcomes, weights: RewardWeights, budget: int = BUDGET) -> dict[str, Any] | None:
    """What `osel_sim.analysis.result.build` says under `verdict`, with orders (how many were replayed); None where there is nothing to choose from.

    Args:
        log: all outcomes of every policy, on some of its instances at least.
        budget: decisions to replay at most.
    """
    return deepcopy(_remembered(log, (weights, budget), lambda: _answer(log, weights, budget)))


def _answer(log: LoggedOutcomes, weights: RewardWeights, budget: int) -> dict[str, Any] | None:
    if len(log.policies) < 2:
        return None
    try:
        log, left_out = complete_instances(log, weights)
    except DataError:
        return None
    seeds, decisions = range(min(SEEDS, max(2, budget // len(log)))), min(len(log), max(1, budget // 2))
    setup = Setup(weights, told(log, log, weights, [RECOMMENDED]))
    [choices] = replay(log, [setup], [RECOMMENDED], seeds, decisions)
    best = oracles(log, weights)
    found: dict[str, Any] = build(log, weights, None, with_fixed(choices, best), best, left_out, seeds)["verdict"]
    return found | {"orders": len(seeds)}
