"""Monitors on a table of moments: those that run live are asked at its decision points, and one is learned from all ways on."""

import numpy as np

from osel_sim.analysis.handovers import Handovers, blind, first_turns, never, reward_of
from osel_sim.analysis.learned_handovers import Chosen, learned_turns
from osel_sim.analysis.log import mean_over_repeats
from osel_sim.analysis.moment_arms import Part
from osel_sim.analysis.moment_log import MomentLog
from osel_sim.selection.reward import RewardWeights

BLIND, LEARNED = "blind", "learned"


def best_blind(log: MomentLog, weights: RewardWeights, part: Part) -> tuple[Handovers, dict[str, str]]:
    """For each first policy the blind handover that is best on the instances that are learned from, or none; and their names."""
    result, names = never(log), {}
    options = {"never": never(log)} | {f"blind:{call}:{name}": blind(log, call, to) for call in log.calls for to, name in enumerate(log.policies)}
    means = {name: np.nanmean(mean_over_repeats(reward_of(log, handovers, weights))[part.shown], axis=0) for name, handovers in options.items()}
    for first, policy in enumerate(log.policies):
        names[policy] = max(options, key=lambda name: float(means[name][first]))
        result[:, first] = options[names[policy]][:, first]
    return result, names


def learned(log: MomentLog, weights: RewardWeights, part: Part, look: bool = True, signals: bool = True) -> tuple[Handovers, dict[str, Chosen]]:
    """Handovers learned from all ways on of other instances, and what was decided there."""
    turns, chosen = learned_turns(log, weights, part.shown, part.scored, look, signals)
    return first_turns(log, turns), chosen
