"""A replay of a table of moments: start selectors and monitors compared on what would have come of every handover."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.api.results import MomentsResult
from osel_sim.api.reward import weights_of
from osel_sim.core.errors import DataError, SettingError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.handovers import Handovers
    from osel_sim.analysis.moment_arms import Part
    from osel_sim.analysis.moment_log import MomentLog
    from osel_sim.analysis.targets import Target
    from osel_sim.api.replay_settings import ReplayConfig
    from osel_sim.interface.selector import SelectorFactory
    from osel_sim.selection.reward import RewardWeights

SELECTORS = ("auto", "auto:warm")
"""Start selectors that are compared unless others are named."""
MONITORS = ("stall", "disagreement", "value")
"""Monitors that are compared unless others are named."""
_NOT_HERE = (
    *("decisions", "unknown_costs", "unknown_skills", "no_frontier", "route_with", "targets", "context", "join", "leave", "drift"),
    *("budget_cents", "budget_per", "robots", "share", "share_delay", "robots_by"),
)
"""Settings of other replays."""


def has_moments(folder: Path) -> bool:
    """Whether a folder holds a table of moments."""
    from osel_sim.formats.moments import MOMENTS

    return (folder / MOMENTS).is_file()


def replay_moments(
    config: "ReplayConfig", factories: "Mapping[str, SelectorFactory] | None" = None, targets: "Mapping[str, Target] | None" = None
) -> MomentsResult:
    """Compare monitors and start selectors on a table of moments. See `docs/moments.md`.

    Args:
        factories: start selectors of one's own, by the names that the settings have them by.
        targets: must be none; they are of other replays.

    Raises:
        SettingError: a setting that goes with other replays only.
        UsageError: there is but one policy, or one half has no instances.
        DataError: the table or the rollout log beside it is damaged, or lacks outcomes of a policy.
    """
    from osel_sim.analysis.moment_arms import Starts
    from osel_sim.analysis.moment_log import read_moment_log
    from osel_sim.analysis.moment_result import Question, study
    from osel_sim.analysis.moment_tables import tables
    from osel_sim.api.replay_settings import choose_selectors
    from osel_sim.formats.moments_result import MOMENTS_RESULT, write_moments_result
    from osel_sim.formats.replay_result import check_replay_folder, drop_others

    for name in _NOT_HERE:
        if name in config.given:
            raise SettingError(name, f"{config.log} holds a table of moments, whose replay has no such setting; leave it out")
    if targets:
        raise SettingError("targets", f"{config.log} holds a table of moments: a target is estimated from a live run or from logged decisions")
    own = dict(factories or {})
    selectors = [*choose_selectors([name for name in config.selectors or SELECTORS if name not in own], halved=True), *own]
    check_replay_folder(config.folder, config.overwrite)
    log = read_moment_log(config.log, config.encoder)
    if config.policies:
        log = log.only(tuple(config.policies))
    weights, preset = weights_of(config, log.whole.metadata)
    part = _part(log, config.half or "score")
    _check_policies(log, weights, part)
    monitors, about = _monitors(log, weights, part, config.monitors or MONITORS)
    starts = Starts(selectors, range(config.seeds), config.workers, own)
    result = study(log, weights, monitors, Question(starts, part, config.margin))
    metadata = log.metadata
    result["log"] = {"folder": str(config.log), "encoder": log.whole.encoder, "half": config.half or "score", "preset": preset}
    result["log"] |= {"every": metadata["every"], "most": metadata["most"], "moments": int(log.there.sum()), "about": about}
    write_moments_result(config.folder, result, tables(result))
    drop_others(config.folder, MOMENTS_RESULT)
    if config.open:
        from osel_sim.api.report import report

        report(config.folder, open=True)
    return MomentsResult(config.folder, result)


def _part(log: "MomentLog", half: Any) -> "Part":
    from osel_sim.analysis.moment_arms import Part

    scored = log.whole.half(half)
    if not scored.any() or scored.all():
        raise UsageError(
            f"all {len(log)} instances of {log.whole.source} are of one half: monitors are learned on one half and scored on the other; record more"
        )
    return Part(scored, ~scored)


def _check_policies(log: "MomentLog", weights: "RewardWeights", part: "Part") -> None:
    """Refuse a table with nobody to hand over to, or with a policy of which one half says nothing."""
    import numpy as np

    if len(log.policies) < 2:
        raise UsageError(f"{log.whole.source}: with {log.policies[0]} alone there is nobody to hand over to; name two policies or more")
    rewards = log.whole.rewards(weights)
    for rows in (part.scored, part.shown):
        for column, policy in enumerate(log.policies):
            if np.isnan(rewards[rows, column]).all():
                raise DataError(
                    f"{log.whole.source}: {policy} has no outcome on any of the {rows.sum()} instances of one half; name others by --policies"
                )


def _monitors(log: "MomentLog", weights: "RewardWeights", part: "Part", names: Sequence[str]) -> "tuple[dict[str, Handovers], dict[str, Any]]":
    """What is compared besides never handing over, and what was decided of it on the other half."""
    from osel_sim.analysis.asked_monitors import asked_turns
    from osel_sim.analysis.handovers import first_turns
    from osel_sim.analysis.moment_monitors import BLIND, LEARNED, best_blind, learned

    without_looking, calls = best_blind(log, weights, part)
    by_all, chosen = learned(log, weights, part)
    found = {BLIND: without_looking}
    found |= {name: first_turns(log, asked_turns(log, weights, name, part.shown, part.scored)) for name in dict.fromkeys(names) if name != "never"}
    found[LEARNED] = by_all
    about: dict[str, Any] = {BLIND: calls, LEARNED: {policy: asdict(own) for policy, own in chosen.items()}}
    for name, look, signals in (("learned, no picture", False, True), ("learned, no signals", True, False)):
        found[name], own = learned(log, weights, part, look, signals)
        about[name] = {policy: asdict(one) for policy, one in own.items()}
    return found, about
