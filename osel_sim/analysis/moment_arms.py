"""Start selectors and monitors together: who is chosen at the beginning, who drives on, and what each instance comes to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.engine import Part as Stream
from osel_sim.analysis.engine import Setup, replay_parts
from osel_sim.analysis.handovers import Handovers, outcomes, recovered_and_harmed, reward_of, with_starts
from osel_sim.analysis.log import Array, LoggedOutcomes
from osel_sim.analysis.moment_log import MomentLog
from osel_sim.analysis.told import told
from osel_sim.analysis.warm_start import WarmStart
from osel_sim.interface.selector import SelectorFactory
from osel_sim.selection.reward import RewardWeights

FIXED = "fixed:"


@dataclass(frozen=True)
class Part:
    """Which instances are for what.

    Attributes:
        scored: (N,) those that everything is measured on.
        shown: (N,) others, that learners learn from, settings are chosen by, and costs are known from.
    """

    scored: NDArray[np.bool_]
    shown: NDArray[np.bool_]


@dataclass(frozen=True)
class Values:
    """What each instance comes to, of one start selector and one monitor; NaN where something that may happen has no outcome.

    Attributes:
        share: (N, P), how likely each first policy is chosen.
        reward: (N,), like all of `measures`: those of `KEPT`.
        lost, recovered: (N,) how likely the first policy alone loses, and that it would and the episode is won all the same.
        won, harmed: (N,) how likely it wins, and that it would and the episode is lost all the same.
    """

    share: Array
    reward: Array
    measures: Mapping[str, Array]
    lost: Array
    recovered: Array
    won: Array
    harmed: Array


def values_of(log: MomentLog, share: Array, handovers: Handovers, weights: RewardWeights) -> Values:
    """What instances come to if first policies are chosen with these probabilities (N, P), and handed over so."""
    parts = [with_starts(part, share) for part in recovered_and_harmed(log, handovers)]
    measures = {name: with_starts(values, share) for name, values in outcomes(log, handovers).items()}
    return Values(share, with_starts(reward_of(log, handovers, weights), share), measures, *parts)


def as_episodes(log: MomentLog, handovers: Handovers) -> LoggedOutcomes:
    """The table's episodes as a rollout log in which the monitor was part of every policy, for start selectors to be replayed on."""
    found = outcomes(log, handovers)
    nothing = np.full_like(found["steps"], np.nan)
    own: dict[str, Any] = {name: found[name] for name in ("success", "subgoals", "steps", "price")}
    return replace(log.whole, **own, motion=found["seconds"], upload=nothing, inference=nothing, download=nothing)


@dataclass(frozen=True)
class Starts:
    """How first policies are chosen.

    Attributes:
        selectors: names, as a replay takes them; `NAME:warm` is shown the other half's episodes, driven with the same monitor.
        seeds: of random orders.
        factories: selector -> what makes it, where it is none of the registry's.
    """

    selectors: Sequence[str]
    seeds: Sequence[int]
    workers: int = 1
    factories: Mapping[str, SelectorFactory] = field(default_factory=dict)

    def fixed(self, log: MomentLog) -> dict[str, Array]:
        """`fixed:NAME` -> share (N, P)."""
        eye = np.eye(len(log.policies))
        return {f"{FIXED}{name}": np.tile(eye[column], (len(log), 1)) for column, name in enumerate(log.policies)}

    def chosen(self, log: MomentLog, handovers: Handovers, weights: RewardWeights, part: Part) -> dict[str, Array]:
        """Selector -> how often it chose each policy, (N, P), learning online from what the episodes came to with the monitor."""
        whole = as_episodes(log, handovers)
        here, others = whole.take(part.scored), whole.take(part.shown)
        named = [name for name in self.selectors if name not in self.factories]
        setup = Setup(weights, told(here, others, weights, named), WarmStart(others.contexts, others.rewards(weights)))
        parts = [Stream(here, [setup], self.selectors, self.seeds)]
        [[choices]] = list(replay_parts(parts, self.workers, factories=self.factories))
        rows = np.flatnonzero(part.scored)
        shares = {name: np.zeros((len(log), len(log.policies))) for name in self.selectors}
        for name, share in shares.items():
            np.add.at(share, (rows[choices.order], choices.chosen[name].astype(np.int64)), 1.0 / len(self.seeds))
        return shares
