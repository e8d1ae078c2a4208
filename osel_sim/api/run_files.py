"""What a live run writes when it ends: summary, learning curve, the selector's state, the page."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import OselError
from osel_sim.core.files import write_bytes

if TYPE_CHECKING:
    from osel_sim.episodes.live import LiveRun

logger = logging.getLogger(__name__)


def write_results(live: "LiveRun", title: str, selector: str) -> tuple[dict[str, Any], Path | None]:
    """Write them.

    Returns:
        the summary, and the page or None where it could not be written; both empty where no decision was made.
    """
    from osel_sim.core.files import write_json
    from osel_sim.formats.summary import summarise
    from osel_sim.selection.state import save_state

    if not live.decisions:
        logger.warning("no decision was made")
        return {}, None
    policies = live.selector.policies
    chosen = [policies.index(decision.policy) for decision in live.decisions]
    summary = {"task": title, **summarise(live.decisions, policies, selector)}
    if live.options.counterfactual:
        summary |= _comparison(live, chosen)
    write_json(live.folder / "summary.json", summary)
    save_state(live.selector.state_dict(), live.folder / "selector.safetensors")
    return summary, _page(live.folder)


def _page(folder: Path) -> Path | None:
    from osel_sim.reporting.page import FIGURES, write_page
    from osel_sim.reporting.run_page import run_page

    try:
        page = write_page(run_page(folder), folder)
        write_bytes(folder / "curve.png", (folder / FIGURES / "curves.png").read_bytes())  # where one looks first
        return page
    except OselError as problem:  # the run itself is complete; python -m osel_sim.report tries again
        logger.warning("no report.html: %s", problem)
        return None


def _comparison(live: "LiveRun", chosen: list[int]) -> dict[str, Any]:
    """What could have been, over the decisions in which every policy has a reward."""
    import numpy as np

    from osel_sim.selection.oracle import compare

    rewards, policies = live.rewards, live.selector.policies
    complete = np.isfinite(rewards).all(axis=1)
    if not complete.any():
        return {}
    result = compare(rewards, chosen)
    return {
        "compared_decisions": result.instances,
        "best_single": result.best_single_reward,
        "best_single_policy": policies[result.best_single],
        "hindsight_oracle": result.hindsight_oracle,
        "regret": result.regret,
        "always": dict(zip(policies, rewards[complete].mean(axis=0).tolist(), strict=True)),
    }
