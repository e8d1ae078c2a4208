"""A live run's folder as material for offline evaluation: what was chosen, with which probability, and what came of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.log import Array, LoggedInstance, LoggedOutcomes, dense, named_robots, read_contexts
from osel_sim.context.cache import FILE, ContextCache
from osel_sim.core.errors import DataError
from osel_sim.core.files import read_json
from osel_sim.formats.journal import Decision, read_journal, read_lines
from osel_sim.formats.levels import instance_key, label
from osel_sim.formats.rollout_log import ROLLOUTS, Row
from osel_sim.formats.run_config import RUN
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.selection.reward import RewardWeights

JOURNAL, COUNTERFACTUAL, SUMMARY = "episodes.jsonl", "counterfactual.jsonl", "summary.json"

ABOUT = ("task", "seed", "level", "axes", "split", "instruction", "phrasing", "target", "container", "robot")
"""What a decision says of its instance."""


@dataclass(frozen=True)
class LiveLog:
    """T decisions, P policies.

    Attributes:
        outcomes: one instance a decision, one repeat; NaN for the policies that were not chosen, unless the run was made with `--counterfactual`.
        chosen: (T,) columns.
        propensities: (T, P) with which each policy would have been chosen.
        selector: name of the selector that chose.
        reward: weights that the run was made with, as `RewardWeights` takes them.
        decisions: the journal's, T of them.
    """

    outcomes: LoggedOutcomes
    chosen: NDArray[np.int64]
    propensities: Array
    selector: str
    reward: dict[str, Any]
    decisions: tuple[Decision, ...]

    def has_all_outcomes(self, weights: RewardWeights) -> bool:
        """Whether some decision has the outcome of every policy, so that selectors can be replayed on it."""
        return bool(np.isfinite(self.outcomes.mean_rewards(weights)).all(axis=1).any())


def is_live_run(folder: Path) -> bool:
    """Whether the folder holds a live run's journal and no rollout log."""
    return (folder / JOURNAL).is_file() and not (folder / ROLLOUTS).is_file()


def read_live(folder: Path, encoder: str | None = None) -> LiveLog:
    """Read a live run.

    Args:
        encoder: whose contexts; None: the run's.

    Raises:
        DataError: its files are missing or damaged, it made no decision, or an instance has no context.
    """
    configuration = read_json(folder / RUN).get("configuration", {})
    policies = configuration.get("policies")
    if not isinstance(policies, list) or not policies or not all(isinstance(name, str) for name in policies):
        raise DataError(f"{folder / RUN}: configuration.policies must name the policies, got {policies!r}")
    decisions = _as_far_as_contexts(folder, read_journal(folder / JOURNAL), encoder or configuration.get("encoder"))
    if not decisions:
        raise DataError(f"{folder / JOURNAL}: the run made no decision")
    for decision in decisions:
        if decision.policy not in policies or not decision.propensities.get(decision.policy, 0.0) > 0.0:
            raise DataError(f"{folder / JOURNAL}, line {decision.index + 1}: {decision.policy!r} is no policy of the run, or has no propensity")
    instances = named_robots(
        LoggedInstance(_key(decision), **{name: getattr(decision, name) for name in ABOUT if name != "axes"}) for decision in decisions
    )
    rows = [_row(decision, decision.policy, decision.outcome) for decision in decisions]
    for number, (data, _) in enumerate(read_lines(folder / COUNTERFACTUAL)):
        if number < len(decisions):
            rows += [_row(decisions[number], policy, outcome) for policy, outcome in _others(data, folder, number)]
    keys = [instance.key for instance in instances]
    identity, contexts = read_contexts(folder, keys, encoder or configuration.get("encoder"))
    arrays, errors = dense(folder, rows, keys, policies)
    outcomes = LoggedOutcomes(folder, instances, tuple(policies), contexts, identity, **arrays, errors=errors, metadata=configuration, skills=None)
    propensities = np.array([[decision.propensities.get(policy, 0.0) for policy in policies] for decision in decisions], np.float64)
    chosen = np.array([policies.index(decision.policy) for decision in decisions], np.int64)
    return LiveLog(
        outcomes, chosen, propensities, str(configuration.get("selector", "unknown")), dict(configuration.get("reward", {})), tuple(decisions)
    )


def _as_far_as_contexts(folder: Path, decisions: list[Decision], encoder: str | None) -> list[Decision]:
    """The decisions without the last few that have no context yet, in a run that goes on or was killed: contexts are written some at a time."""
    if encoder is None or not (folder / FILE).is_file():
        return decisions
    cache = ContextCache(folder)
    have = [cache.get(encoder, _key(decision)) is not None for decision in decisions]
    known = sum(have)
    finished = read_json(folder / SUMMARY).get("decisions", 0) if (folder / SUMMARY).is_file() else 0
    return decisions[:known] if all(have[:known]) and known > 0 and known >= finished else decisions


def _key(decision: Decision) -> str:
    return instance_key(decision.task, decision.split, label(decision.level, decision.axes), decision.seed, decision.robot)


def _others(data: dict[str, Any], folder: Path, number: int) -> list[tuple[str, Outcome]]:
    """Outcomes of the policies that were not chosen, from one line of `counterfactual.jsonl`."""
    try:
        found = []
        for policy, values in data["policies"].items():
            own = {key: value for key, value in values.items() if key != "reward"}
            found.append((str(policy), Outcome(**{**own, "seconds": Seconds(**own["seconds"])})))
        return found
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{folder / COUNTERFACTUAL}, line {number + 1}: not outcomes of policies ({error})") from None


def _row(decision: Decision, policy: str, outcome: Outcome) -> Row:
    own = {key: value for key, value in vars(outcome).items() if key != "seconds"}
    about: dict[str, Any] = {name: getattr(decision, name) for name in ABOUT}
    return Row(**about, instance=_key(decision), policy=policy, repeat=0, **own, **vars(outcome.seconds))
