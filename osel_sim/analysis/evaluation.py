"""Off-policy estimates of a live run: each fixed policy, random choice, the best choice by a linear model, and targets of one's own."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from osel_sim.analysis.estimate import mean_of
from osel_sim.analysis.live import LiveLog
from osel_sim.analysis.log import Array
from osel_sim.analysis.off_policy import estimate, forward_model, greedy
from osel_sim.core.errors import DataError
from osel_sim.selection.reward import RewardWeights


def evaluate(live: LiveLog, weights: RewardWeights, own: Mapping[str, Array] | None = None) -> dict[str, Any]:
    """What `off_policy.json` holds, and `replay.json` under `off_policy`.

    Args:
        own: targets of one's own by name, probabilities (T, P) each (`osel_sim.analysis.targets`).

    Returns:
        run (folder, selector, decisions, errors, mean_reward, ci95), reward, policies, targets: name -> what an
        `osel_sim.analysis.off_policy.OffPolicyEstimate` holds, with `few` (which estimates rest on too few decisions to be relied upon) and
        `measured`: where the run has every outcome, what the target would really have come to, else None.
        The targets are `fixed:<policy>`, `random`, `greedy` (the policy of the highest reward by a linear model of the decisions so far), and those
        of one's own.

    Raises:
        DataError: every decision ended in error.
    """
    log = live.outcomes
    received = log.rewards(weights)[np.arange(len(log)), live.chosen, 0]
    valid = np.isfinite(received)
    if not valid.any():
        raise DataError(f"{log.source}: none of {len(log)} decisions has a reward")
    rewards, chosen, propensities, contexts = received[valid], live.chosen[valid], live.propensities[valid], log.contexts[valid]
    # An episode that ends in error has no reward. Where that happens to some policies more than to others, what is left has fewer decisions of
    # those than the run meant to make: each counts as chosen with the probability of being chosen and of ending well.
    share = np.array([valid[live.chosen == column].mean() if (live.chosen == column).any() else 1.0 for column in range(len(log.policies))])
    propensities = propensities * share / valid.mean()
    model = forward_model(contexts, rewards, chosen, len(log.policies))
    targets = {f"fixed:{policy}": np.tile(np.eye(len(log.policies))[column], (len(rewards), 1)) for column, policy in enumerate(log.policies)}
    targets |= {"random": np.full_like(propensities, 1.0 / len(log.policies)), "greedy": greedy(model)}
    targets |= {name: target[valid] for name, target in (own or {}).items()}
    outcomes = log.mean_rewards(weights)
    everywhere = np.isfinite(outcomes).all(axis=1).any()
    found = {}
    for name, target in targets.items():
        one = estimate(rewards, chosen, propensities, target, model)
        measured = None
        if everywhere:  # else what is known of a target is the decisions in which the run happened to agree
            fixed = name.startswith("fixed:")
            measured = _measured(outcomes, np.tile(target[0], (len(log), 1))) if fixed else _measured(outcomes[valid], target)
        found[name] = {**asdict(one), "few": list(one.few), "measured": measured}
    received_mean = mean_of(rewards)
    return {
        "run": {
            "folder": str(log.source),
            "selector": live.selector,
            "decisions": len(rewards),
            "errors": int((~valid).sum()),
            "mean_reward": float(rewards.mean()),
            "ci95": [received_mean.low, received_mean.high] if received_mean else None,
        },
        "reward": asdict(weights),
        "policies": list(log.policies),
        "targets": {name: {key: _json(value) for key, value in entry.items()} for name, entry in found.items()},
    }


def _measured(outcomes: Array, target: Array) -> float | None:
    """Mean reward of a target, of rewards (T, P) and its probabilities (T, P): over the decisions in which all that it may choose is known."""
    terms = np.where(target > 0.0, outcomes, 0.0) * target
    known = np.isfinite(terms).all(axis=1)
    return float(terms.sum(axis=1)[known].mean()) if known.any() else None


def _json(value: Any) -> Any:
    """An interval as a list; None where it is unbounded."""
    if not isinstance(value, tuple):
        return value
    return list(value) if all(math.isfinite(end) for end in value) else None
