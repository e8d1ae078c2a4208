"""A live run's folder as material for offline evaluation: what was chosen, with which probability, and what came of it."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, LoggedInstance, LoggedOutcomes, dense, named_robots, read_contexts
from osel_sim.context.cache import FILE, ContextCache
from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.formats.counterfactual import COUNTERFACTUAL, to_others
from osel_sim.formats.journal import JOURNAL, SEEDS_PER_RUN, TIMING, Decision, check_beside, check_digests, read_journal, read_lines
from osel_sim.formats.policy_changes import PolicyChange, available, ever, read_changes
from osel_sim.formats.rollout_log import ROLLOUTS, Row
from osel_sim.formats.run_config import RUN, read_run
from osel_sim.formats.summary import SUMMARY
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import COUNT, NAME, TEXT
from osel_sim.interface.outcome import Outcome
from osel_sim.selection.reward import RewardWeights, check_reward, weights_from

ABOUT = ("task", "seed", "level", "axes", "split", "instruction", "phrasing", "target", "container", "robot", "scene")
"""What a decision says of its instance."""


@dataclass(frozen=True)
class LiveLog:
    """T decisions, P policies.

    Attributes:
        decisions: (T,) of the journal; none of a log of somebody else's decisions.
        outcomes: one instance a decision, one repeat; NaN for the policies that were not chosen, unless the run was made with `--counterfactual`.
        chosen: (T,) columns.
        propensities: (T, P) with which each policy would have been chosen.
        selector: name of the selector that chose.
        reward: weights that the run was made with, as `RewardWeights` takes them.
        received: as `outcomes`, but of the policies that were chosen what the run itself came to: a monitor may have handed over.
        changes: policies that joined and left; `outcomes` has all that ever were, of which one that was not there has the propensity 0.
    """

    decisions: tuple[Decision, ...]
    outcomes: LoggedOutcomes
    chosen: NDArray[np.int64]
    propensities: Array
    selector: str
    reward: dict[str, Any]
    received: LoggedOutcomes
    changes: tuple[PolicyChange, ...] = ()

    def has_all_outcomes(self, weights: RewardWeights) -> bool:
        """Whether some decision has the outcome of every policy, so that selectors can be replayed on it."""
        return bool(np.isfinite(self.outcomes.mean_rewards(weights)).all(axis=1).any())


def is_live_run(folder: Path) -> bool:
    """Whether the folder holds what a live run leaves, and no rollout log."""
    return any((folder / name).is_file() for name in (JOURNAL, COUNTERFACTUAL)) and not (folder / ROLLOUTS).is_file()


def read_live(folder: Path, encoder: str | None = None) -> LiveLog:
    """Read a live run.

    Args:
        encoder: whose contexts; None: the run's.

    Raises:
        DataError: its files are missing or damaged, do not fit together, it made no decision, or an instance has no context.
    """
    configuration = _configuration(folder)
    initial, weights = configuration["policies"], weights_from(configuration["reward"], f"{folder / RUN}: configuration.reward")
    changes = read_changes(folder, initial)
    policies = list(ever(initial, changes))
    journal = read_journal(folder / JOURNAL)
    for name in (COUNTERFACTUAL, TIMING):
        check_beside(folder / name, len(journal))
    for name in (JOURNAL, COUNTERFACTUAL):
        check_digests(folder / name)
    decisions = _as_far_as_contexts(folder, journal, encoder or configuration.get("encoder"))
    if not decisions:
        raise DataError(f"{folder / JOURNAL}: the run made no decision")
    for decision in decisions:
        there = available(initial, changes, decision.index)
        _check(decision, configuration, there, weights, f"{folder / JOURNAL}, line {decision.index + 1}")
    instances = named_robots(
        LoggedInstance(decision.instance, **{name: getattr(decision, name) for name in ABOUT if name != "axes"}) for decision in decisions
    )
    own = [decision.outcome for decision in decisions]
    alone = list(own)
    rows: list[Row] = []
    for decision, (data, _) in zip(decisions, read_lines(folder / COUNTERFACTUAL), strict=False):  # a killed run may have one line more
        there = available(initial, changes, decision.index)
        others = to_others(data, decision.index, folder / COUNTERFACTUAL, there, decision.policy)
        for policy, outcome in others.outcomes.items():
            check_reward(others.rewards[policy], outcome, weights, f"{folder / COUNTERFACTUAL}, line {decision.index + 1}: {policy}")
            rows.append(_row(decision, policy, outcome))
        if others.alone is not None:  # what a monitor made of it is not the policy's own, which the others are compared with
            check_reward(others.alone_reward, others.alone, weights, f"{folder / COUNTERFACTUAL}, line {decision.index + 1}: alone")
            alone[decision.index] = others.alone
    if (folder / COUNTERFACTUAL).exists() or configuration.get("counterfactual") is True:
        check_beside(folder / COUNTERFACTUAL, len(journal), complete=True)
    keys = [instance.key for instance in instances]
    identity, contexts = read_contexts(folder, keys, encoder or configuration.get("encoder"))

    def with_chosen(came_to: Sequence[Outcome]) -> dict[str, Any]:
        mine = [_row(decision, decision.policy, outcome) for decision, outcome in zip(decisions, came_to, strict=True)]
        return dense(folder, [*rows, *mine], keys, policies)

    told = configuration | _told(changes)
    outcomes = LoggedOutcomes(folder, instances, tuple(policies), contexts, identity, **with_chosen(alone), metadata=told, skills=None)
    received = outcomes if alone == own else replace(outcomes, **with_chosen(own))
    propensities = np.array([[decision.propensities.get(policy, 0.0) for policy in policies] for decision in decisions], np.float64)
    chosen = np.array([policies.index(decision.policy) for decision in decisions], np.int64)
    selector = str(configuration.get("selector", "unknown"))
    return LiveLog(tuple(decisions), outcomes, chosen, propensities, selector, asdict(weights), received, changes)


def _told(changes: Sequence[PolicyChange]) -> dict[str, Any]:
    """What the facts about a run say of its changes."""
    return {"changes": [change.words for change in changes]} if changes else {}


def _as_far_as_contexts(folder: Path, decisions: list[Decision], encoder: str | None) -> list[Decision]:
    """The decisions without the last few that have no context yet, in a run that goes on or was killed: contexts are written some at a time."""
    if encoder is None or not (folder / FILE).is_file():
        return decisions
    cache = ContextCache(folder)
    have = [cache.get(encoder, decision.instance) is not None for decision in decisions]
    known = sum(have)
    finished = read_json(folder / SUMMARY).get("decisions", 0) if (folder / SUMMARY).is_file() else 0
    return decisions[:known] if all(have[:known]) and known > 0 and known >= finished else decisions


def _configuration(folder: Path) -> dict[str, Any]:
    """The run's configuration, with all that is read of it in the promised form."""
    configuration: dict[str, Any] = read_run(folder)["configuration"]
    place = f"{folder / RUN}: configuration"
    policies = configuration.get("policies")
    if not isinstance(policies, list) or not policies or not all(map(NAME.fits, policies)) or len(set(policies)) < len(policies):
        raise DataError(f"{place}.policies must name the policies, got {quoted(policies)}")
    for key, kind in (("encoder", NAME), ("selector", TEXT), ("split", NAME), ("seed", COUNT)):
        if key in configuration and not kind.fits(configuration[key]):
            raise DataError(f"{place}.{key} must be {kind.wanted}, got {quoted(configuration[key])}")
    tasks = configuration.get("tasks", [])
    if not isinstance(tasks, list) or not all(map(NAME.fits, tasks)):
        raise DataError(f"{place}.tasks must name the tasks, got {quoted(tasks)}")
    if "reward" not in configuration:
        raise DataError(f"{place}.reward is missing")
    return configuration


def _check(decision: Decision, configuration: Mapping[str, Any], there: Sequence[str], weights: RewardWeights, place: str) -> None:
    """Refuse a decision that this run cannot have made, whose policies then were `there`."""
    if decision.policy not in there or not decision.propensities[decision.policy] > 0.0:
        raise DataError(f"{place}: {decision.policy!r} is no policy of the run, or has no propensity")
    if unknown := set(decision.propensities) - set(there):
        raise DataError(f"{place}: propensities of policies that the run does not have: {quoted(sorted(unknown))}")
    tasks = configuration.get("tasks")
    if tasks and decision.task not in tasks:
        raise DataError(f"{place}: task must be one of the run's ({', '.join(tasks)}), got {decision.task!r}")
    if (split := configuration.get("split", decision.split)) != decision.split:
        raise DataError(f"{place}: split must be the run's, {split!r}, got {decision.split!r}")
    if "seed" in configuration and decision.seed != (seed := configuration["seed"] * SEEDS_PER_RUN + decision.index):
        raise DataError(f"{place}: seed must be {seed}, the run's for this decision, got {decision.seed}")
    check_reward(decision.reward, decision.outcome, weights, place)


def _row(decision: Decision, policy: str, outcome: Outcome) -> Row:
    own = {key: value for key, value in vars(outcome).items() if key not in ("seconds", "monitored")}
    about: dict[str, Any] = {name: getattr(decision, name) for name in ABOUT}
    return Row(**about, instance=decision.instance, policy=policy, repeat=0, **own, **vars(outcome.seconds))
