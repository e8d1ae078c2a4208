"""A replay of streams that change: policies join and leave, prices change, policies get worse."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import SettingError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.analysis.streams import LeftOut
    from osel_sim.api.replay_settings import ReplayConfig
    from osel_sim.api.results import ReplayResult
    from osel_sim.interface.selector import SelectorFactory

logger = logging.getLogger(__name__)


def changes_asked(config: "ReplayConfig") -> bool:
    """Whether anything is to change."""
    return bool(config.join or config.leave or config.drift)


def check_changes(config: "ReplayConfig") -> None:
    """Refuse settings of the verdict for streams that change: what is reported of those are the changes.

    Raises:
        SettingError: there is one.
    """
    for name in ("margin", "route_with"):
        if changes_asked(config) and name in config.given:
            raise SettingError(name, "is for a verdict, and streams that change have none: leave it out, or --join, --leave and --drift")


def check_all_outcomes(config: "ReplayConfig", known: bool) -> None:
    """Refuse to change a stream of which only the outcomes of what was chosen are known.

    Raises:
        UsageError: it is one.
    """
    if changes_asked(config) and not known:
        raise UsageError(
            f"--join, --leave and --drift replay selectors, which needs the outcomes of every policy: {config.log} does not have them; "
            "record a log (python -m osel_sim.record), or make the run with --counterfactual"
        )


def replay_changes(
    config: "ReplayConfig",
    log: "LoggedOutcomes",
    setup: "Setup",
    selectors: Sequence[str],
    left_out: "LeftOut",
    preset: str | None,
    factories: "Mapping[str, SelectorFactory]",
    tell: "Callable[[ReplayResult], ReplayResult]",
) -> "ReplayResult":
    """Replay selectors on streams that change, write what came of it and tell.

    Args:
        log: complete instances only.

    Raises:
        OselError: a change that is none, or a selector whose policies cannot come and go.
    """
    from osel_sim.analysis.changing_replay import ChangingLog, replay_changing, total_decisions
    from osel_sim.analysis.changing_result import build_changes
    from osel_sim.analysis.result import tables
    from osel_sim.analysis.stream_changes import timeline
    from osel_sim.api.results import ReplayResult
    from osel_sim.core.progress import progress
    from osel_sim.formats.replay_result import write_replay

    decisions = len(log) if config.decisions is None else config.decisions
    line = timeline(config.join, config.leave, config.drift, log.policies, decisions)
    material = ChangingLog.of(log, setup, line, range(config.seeds))
    with progress(total_decisions(line, len(selectors), config.seeds), "decision", scale=True) as bar:
        chosen = replay_changing(material, selectors, config.workers, bar.update, factories)
    about = {"half": config.half, "context": config.context}
    result, choices = build_changes(material, {name: chosen[name] for name in selectors}, left_out, preset, about)
    write_replay(config.folder, result, choices, {"selectors": tables(result)["selectors"], "changes": _change_rows(result)})
    return tell(ReplayResult(config.folder, result))


def _change_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a selector and change: what it received soon after it, and against the others."""
    rows = []
    for name, entry in result["changes"]["selectors"].items():
        for span in entry["spans"]:
            for part in ("soon", "whole"):
                own = span[part]
                row = {"selector": name, "at": span["from"], "change": "; ".join(span["changes"]), "part": part, "decisions": own["decisions"]}
                row |= {key: own[key] for key in ("mean_reward", "mean_reward_afresh", "mean_reward_knew")}
                for key in ("against_knew", "against_afresh", "against_oracle"):
                    low, high = own[key]["ci95"] or (None, None)
                    row |= {key: own[key]["mean"], f"{key}_low": low, f"{key}_high": high, f"{key}_sum": own[key]["sum"]}
                rows.append(row)
    return rows
