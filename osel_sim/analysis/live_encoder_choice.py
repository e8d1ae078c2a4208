"""Which of several encoders tells most about rewards, from a live run: of each decision only what came of the chosen policy is known."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.encoder_choice import best_encoder
from osel_sim.analysis.log import Array
from osel_sim.formats.encoder_choice import EncoderChoice
from osel_sim.formats.journal import Decision

PARTS = 5
"""Each fifth of the decisions is scored by what was learned on the other four: halves of some dozens are too few to learn from."""

HEAVIEST = 10.0
"""What one decision may count for at most: those of a policy that was hardly ever chosen weigh less than they should, and gains look smaller."""


def choose_live(decisions: Sequence[Decision], policies: Sequence[str], contexts: Mapping[str, NDArray[np.float32]]) -> EncoderChoice:
    """The encoder on whose contexts a router earns most, as `choose_encoder` finds it of a log: it stays the usual one unless another is clearly
    ahead of it, and of the best single policy.

    Args:
        decisions: T so far; those that ended in an error are left out.
        policies: among which it is to be chosen.
        contexts: identity -> (T, D); the first is the usual one.
    """
    rows = np.array([row for row, decision in enumerate(decisions) if decision.reward is not None], np.int64)
    rewards = doubly_robust([decisions[row] for row in rows], policies)
    return best_encoder({name: table[rows] for name, table in contexts.items()}, rewards, np.arange(len(rows)) % PARTS)


def doubly_robust(decisions: Sequence[Decision], policies: Sequence[str]) -> Array:
    """Reward (T, P) of every policy in every decision, as far as what was chosen tells: its mean, and where it was chosen the rest, weighted by how
    rarely it is (Dudik, Langford and Li 2011, "Doubly robust policy evaluation and learning").

    Args:
        decisions: with rewards.
    """
    received = np.array([decision.reward for decision in decisions], np.float64)
    weights = np.array([min(1.0 / decision.propensities[decision.policy], HEAVIEST) for decision in decisions], np.float64)
    names = np.array([decision.policy for decision in decisions])
    told = np.empty((len(decisions), len(policies)))
    for column, policy in enumerate(policies):
        own = names == policy
        mean = (received[own].sum() + received.mean()) / (own.sum() + 1.0) if len(received) else 0.0
        told[:, column] = mean + np.where(own, weights * (received - mean), 0.0)
    return told
