"""A recording that stops as soon as its policies are told apart: what it is compared with, and what it says in the end."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import DataError, SettingError, UsageError
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import NAME

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.analysis.until_decided import UntilDecided
    from osel_sim.api.results import RecordResult
    from osel_sim.episodes.workers import Plan

logger = logging.getLogger(__name__)


def instances_of(log: "LoggedOutcomes") -> dict[str, int]:
    """How many seeds a baseline's log has, and from which on: one that was stopped early has fewer than were planned.

    Raises:
        DataError: its instances have no seeds, or some between the first and the last are missing.
    """
    seeds = {instance.seed for instance in log.instances}
    known = sorted(seed for seed in seeds if seed is not None)
    if None in seeds or known != list(range(known[0], known[0] + len(known))):
        raise DataError(f"--baseline {log.source}: its instances are not of seeds without gaps: give --task, --start-seed and --instances")
    return {"instances": len(known), "start_seed": known[0]}


def said(
    plan: "Plan", margin: float, baseline: "LoggedOutcomes | None", baseline_policy: str | None, began: Mapping[str, Any] | None
) -> dict[str, Any]:
    """What `run.json` and the log say of it.

    Args:
        baseline_policy: as it was given.
        began: the configuration the recording began with; None of a new one.

    Raises:
        SettingError: nothing to compare, or the baseline has several policies and none is named.
        DataError: what it began with does not have the promised form.
    """
    from osel_sim.analysis.until_decided import UNTIL_DECIDED, seeds_a_look
    from osel_sim.core.files import file_digest
    from osel_sim.formats.rollout_log import ROLLOUTS

    policies = [spec.name for spec in plan.policies]
    if began is not None and began.get(UNTIL_DECIDED) is not None:
        then = began[UNTIL_DECIDED]
        if not isinstance(then, dict) or not isinstance(then.get("policies"), list) or not set(then["policies"]) <= set(policies):
            raise DataError(f"run.json: {UNTIL_DECIDED} does not have the promised form, or names policies that are not recorded")
        policies = then["policies"]  # policies that came later do not decide
    if len(policies) < 2 and baseline is None:
        raise SettingError("until_decided", f"{policies[0]} alone is compared with nothing: name another policy, or give --baseline LOG")
    told = {"margin": margin, "seeds_a_look": seeds_a_look(len(plan.tasks), len(set(plan.levels))), "policies": policies}
    if baseline is not None:
        told["baseline_policy"] = _policy_of(baseline, baseline_policy, policies)
        told["baseline_sha256"] = file_digest(baseline.source / ROLLOUTS)
    return {UNTIL_DECIDED: told}


def stopping(plan: "Plan", configuration: Mapping[str, Any], baseline: "LoggedOutcomes | None", folder: Path) -> "UntilDecided":
    """What looks at the recording.

    Raises:
        UsageError: the baseline lacks instances.
        DataError: it was recorded under other conditions.
    """
    from osel_sim.analysis.pairing import check_same_conditions
    from osel_sim.analysis.until_decided import UNTIL_DECIDED, UntilDecided

    told = configuration[UNTIL_DECIDED]
    if baseline is None:
        return UntilDecided(plan, told["policies"], told["margin"])
    check_same_conditions((baseline.source, baseline.metadata), (folder, configuration))
    return UntilDecided(plan, told["policies"], told["margin"], (baseline, told["baseline_policy"]))


def concluded(result: "RecordResult", plan: "Plan", configuration: Mapping[str, Any], baseline: "LoggedOutcomes | None") -> "RecordResult":
    """The result with what `compare` says of the log, and how many episodes were not needed."""
    from osel_sim.analysis.comparison import compare
    from osel_sim.analysis.log import read_outcomes
    from osel_sim.analysis.pairing import Contender
    from osel_sim.analysis.until_decided import UNTIL_DECIDED
    from osel_sim.api.reward import DEFAULT_PRESET
    from osel_sim.selection.reward import preset

    told, log = configuration[UNTIL_DECIDED], read_outcomes(result.folder)
    contenders = [Contender(name, name, log) for name in told["policies"]]
    if baseline is not None:
        policy = told["baseline_policy"]
        name = f"{policy}@{baseline.source}" if policy in told["policies"] else policy
        contenders.insert(0, Contender(name, policy, baseline))
    try:
        comparison = compare(contenders, preset(DEFAULT_PRESET), told["margin"])
    except DataError as error:  # nothing but errors, say: the log is there all the same
        logger.warning("%s", error)
        comparison = None
    spared = sum(len(plan.episodes(key)) for key in plan.instances.keys() - set(log.keys))
    return replace(result, comparison=comparison, instances=len(log), planned=len(plan.instances), spared=spared)


def baseline_then(settings: Any, folder: Path) -> Path | None:
    """The baseline's folder as an interrupted recording was given it.

    Raises:
        UsageError: it is no longer there.
    """
    told = settings.get("baseline") if isinstance(settings, dict) else None
    if told is None:
        return None
    if not NAME.fits(told) or not Path(told).is_dir():
        raise UsageError(f"the baseline of {folder} is no longer in {quoted(told)}; give its folder with --baseline")
    return Path(told)


def _policy_of(baseline: "LoggedOutcomes", named: str | None, policies: list[str]) -> str:
    if named is not None:
        return baseline.only([named]).policies[0]
    if len(baseline.policies) == 1:
        return baseline.policies[0]
    if len(policies) == 1 and policies[0] in baseline.policies:
        return policies[0]
    raise SettingError("baseline_policy", f"is missing: {baseline.source} has several policies, {', '.join(baseline.policies)}")
