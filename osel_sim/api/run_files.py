"""What a live run writes when it ends, beside its page: summary and the selector's state."""

import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from osel_sim.episodes.live import LiveRun

logger = logging.getLogger(__name__)


def write_results(live: "LiveRun", title: str, selector: str) -> dict[str, Any]:
    """Write them. Returns the summary, empty where no decision was made."""
    from statistics import mean

    from osel_sim.core.files import write_json
    from osel_sim.formats.summary import SUMMARY, summarise
    from osel_sim.selection.budget import Budgeted
    from osel_sim.selection.fleet import members
    from osel_sim.selection.state import save_state

    if not live.decisions:
        logger.warning("no decision was made")
        return {}
    policies = live.policies
    chosen = [policies.index(decision.policy) for decision in live.decisions]
    summary = {"task": title, **summarise(live.decisions, policies, selector)}
    if live.options.counterfactual:
        summary |= _comparison(live, chosen)
    both = [(decision.reward, alone) for decision, alone in zip(live.decisions, live.alone, strict=False)]
    known = [(reward, alone) for reward, alone in both if reward is not None and alone is not None]
    if known:
        summary["monitor"] |= {"compared_decisions": len(known), "with": mean([one for one, _ in known]), "without": mean([one for _, one in known])}
    if (trial := live.options.trial) is not None:
        summary["encoder"] = {"identity": live.encoder.identity, "text": trial.words}
    write_json(live.folder / SUMMARY, summary)
    within = live.selector.inner if isinstance(live.selector, Budgeted) else live.selector
    # A selector of one's own need only choose and learn; a resumed run learns from the journal anyway.
    if all(hasattr(selector, "state_dict") for selector in members(within)):
        save_state(live.selector.state_dict(), live.folder / "selector.safetensors")
    return summary


def _comparison(live: "LiveRun", chosen: list[int]) -> dict[str, Any]:
    """What could have been, over the decisions in which every policy has a reward."""
    import numpy as np

    from osel_sim.selection.oracle import compare

    received, policies = live.rewards, live.policies
    rewards = received.copy()
    for row, alone in enumerate(live.alone):  # a policy that always drives has no monitor; what was received had one
        rewards[row, chosen[row]] = np.nan if alone is None else alone
    complete = np.isfinite(rewards).all(axis=1) & np.isfinite(received).all(axis=1)
    if not complete.any():
        return {}
    rewards, received = rewards[complete], received[complete]
    columns = np.array(chosen)[complete]
    result = compare(rewards, columns.tolist())
    mean_received = float(received[np.arange(len(columns)), columns].mean())
    return {
        "compared_decisions": result.instances,
        "best_single": result.best_single_reward,
        "best_single_policy": policies[result.best_single],
        "hindsight_oracle": result.hindsight_oracle,
        "regret": result.regret if not live.alone else result.hindsight_oracle - mean_received,
        "always": dict(zip(policies, rewards.mean(axis=0).tolist(), strict=True)),
    }
