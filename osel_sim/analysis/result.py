"""A replay from choices to `replay.json`: everything measured, and the tables."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.measures import Curves, curves, difference_ends, measure_fixed, measure_selector, paired, played
from osel_sim.analysis.oracles import Oracles
from osel_sim.analysis.streams import LeftOut
from osel_sim.analysis.verdict import MARGIN, advisable, verdict
from osel_sim.analysis.verdict_words import headline, limit, sentences
from osel_sim.analysis.weights_map import AXES
from osel_sim.formats.replay_result import Choices
from osel_sim.selection.reward import RewardWeights

BEST, WORST = "best_single", "worst_single"
REFERENCES = (BEST, WORST)
"""Selectors that need the whole log to be known: the fixed policies of the best and of the worst mean reward."""


def with_fixed(choices: Choices, best: Oracles) -> Choices:
    """The choices with those of every fixed policy added, and of the best and the worst under names of their own."""
    shape = choices.order.shape
    fixed = {f"fixed:{policy}": np.full(shape, column, np.int16) for column, policy in enumerate(choices.policies)}
    singles = {name: np.full(shape, column, np.int16) for name, column in ((BEST, best.best_single), (WORST, best.worst_single))}
    return Choices(choices.instances, choices.policies, choices.order, choices.repeats, {**choices.chosen, **singles, **fixed})


@dataclass(frozen=True)
class Question:
    """What a verdict is asked.

    Attributes:
        margin: a gain in reward a decision below it is not worth routing for.
        halved: whether selectors were shown the log's other half where they start warm.
        route_with: selectors that the verdict may advise; None: those that we recommend (`osel_sim.analysis.verdict.advisable`).
    """

    margin: float = MARGIN
    halved: bool = False
    route_with: Sequence[str] | None = None


def build(
    log: LoggedOutcomes,
    weights: RewardWeights,
    preset: str | None,
    choices: Choices,
    best: Oracles,
    left_out: LeftOut,
    seeds: Sequence[int],
    question: Question = Question(),
) -> dict[str, Any]:
    """What `replay.json` holds. May be called at any moment, of the selectors that are there so far.

    Args:
        log: the instances of `choices`, in its order.
        preset: name of the paper's weights, where they are that.
        choices: with the fixed policies (`with_fixed`).
        question: of the verdict.

    Returns:
        log (folder, instances, left_out, policies, repeats, encoder, tasks), reward, seeds, decisions, selectors, oracles, learnable_oracle, paired,
        verdict, and frontier, which is None until it is replayed (`osel_sim.analysis.frontier`). Each selector has a `kind`: `learner`, `random` or
        `fixed` (with its `policy`).
    """
    rewards = curves(log, weights, choices, best, question.margin)
    policies = choices.policies
    singles = {BEST: policies[best.best_single], WORST: policies[best.worst_single]}
    selectors = _selectors(log, weights, choices, rewards, singles)
    return {
        "log": {
            "folder": str(log.source),
            "tasks": sorted(set(log.labels("task"))),
            "instances": len(log),
            "units": int(rewards.units.max()) + 1,
            "left_out": asdict(left_out),
            "policies": list(policies),
            "repeats": log.repeats,
            "encoder": log.encoder,
        },
        "reward": {"preset": preset, **asdict(weights)},
        "seeds": list(seeds),
        "decisions": int(choices.order.shape[1]),
        "late_from": rewards.late,
        "selectors": selectors,
        "oracles": _oracles(rewards, selectors[BEST]),
        "learnable_oracle": {
            "name": rewards.learnable,
            "repeated": int(np.isfinite(best.expected_gains).sum()),
            "router": best.router,
            "beaten": dict(rewards.beaten),
        },
        "paired": paired(rewards, [*_of_kind(selectors, "learner"), *_of_kind(selectors, "random"), BEST]),
        "verdict": _verdict(log, weights, choices, best, rewards, selectors, question),
        "frontier": None,
    }


def _oracles(rewards: Curves, best: Mapping[str, Any]) -> dict[str, Any]:
    """What each oracle comes to; the best single policy is one of them, with the figures that it has as a selector."""
    always = {BEST: {key: best[key] for key in ("mean_reward", "ci95")}}
    return {
        name: {
            "mean_reward": float(values.mean()),
            "ci95": difference_ends(rewards, name, values),
            "mean_reward_late": float(values[:, rewards.late :].mean()),
            "gain": rewards.gains[name].mean,
            "gain_ci95": rewards.gains[name].ends,
        }
        | always.get(name, {})
        for name, values in rewards.oracles.items()
    }


def _selectors(
    log: LoggedOutcomes, weights: RewardWeights, choices: Choices, rewards: Curves, singles: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """What each came to; a fixed policy, of which the streams show no more than the log does, as the table of policies has it."""
    table = log.mean_rewards(weights)
    always = measure_fixed(log, weights) if choices.order.shape[1] == len(log) else {}
    found = {name: {**kind(name, singles), **measure_selector(log, choices, rewards, name, table)} for name in choices.chosen}
    return {name: entry | always.get(entry.get("policy", ""), {}) for name, entry in found.items()}


def _of_kind(selectors: Mapping[str, Mapping[str, Any]], wanted: str) -> list[str]:
    return [name for name, entry in selectors.items() if entry["kind"] == wanted]


def _verdict(
    log: LoggedOutcomes,
    weights: RewardWeights,
    choices: Choices,
    best: Oracles,
    rewards: Curves,
    selectors: Mapping[str, Mapping[str, Any]],
    question: Question,
) -> dict[str, Any]:
    """The verdict, its words, and what the learnable oracle gains."""
    tested, error = advisable(_of_kind(selectors, "learner"), question.halved, question.route_with)
    found = verdict(played(log, weights, choices, best), tested, rewards.margin, error)
    stake = found["stake"] or {}
    one, other = selectors.get(stake.get("selector", "")), selectors[f"fixed:{found['policy']}"]
    learnable = None if rewards.learnable is None else rewards.gains[rewards.learnable]
    stake |= {} if one is None else {key: _difference(one[key], other[key]) for key in ("success_rate", "mean_seconds", "mean_steps", "mean_price")}
    stake |= {
        "learnable_oracle": rewards.learnable,
        "learnable_gain": None if learnable is None else learnable.mean,
        "learnable_gain_ci95": None if learnable is None else learnable.ends,
    }
    told = sentences(found, one, other, weights, limit(rewards))
    return {**found, "headline": headline(found), "sentences": told, "text": " ".join([f"{headline(found)}.", *told]), "stake": stake}


def _difference(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one - other


def kind(name: str, singles: Mapping[str, str]) -> dict[str, Any]:
    """What sort of selector it is.

    Args:
        singles: policies of the best and the worst single.
    """
    if name in singles:
        return {"kind": "fixed", "policy": singles[name]}
    if name.startswith("fixed:"):
        return {"kind": "fixed", "policy": name.removeprefix("fixed:")}
    return {"kind": "random" if name == "random" else "learner"}


def tables(result: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Tables for CSV files: `selectors`, `oracles`, `paired`, `frontier`; an interval becomes two columns."""
    selectors = [{"selector": name, **_flat(entry)} for name, entry in result["selectors"].items()]
    columns = list(dict.fromkeys(key for row in selectors for key in row))
    frontier = result["frontier"] or {}
    return {
        "selectors": [{key: row.get(key) for key in columns} for row in selectors],
        "oracles": [{"oracle": name, **_flat(entry)} for name, entry in result["oracles"].items()],
        "paired": [_flat(entry) for entry in result["paired"]],
        "frontier": [
            {"weight": axis, "value": value, "selector": name, **{measured: values[at] for measured, values in entry.items()}}
            for axis in AXES
            if axis in frontier
            for name, entry in frontier[axis]["selectors"].items()
            for at, value in enumerate(frontier[axis]["weights"])
        ],
    }


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for key, value in entry.items():
        if "ci95" in key:
            row |= {f"{key}_low": value[0], f"{key}_high": value[1]} if isinstance(value, list) else {}
            if value is None:
                row |= {f"{key}_low": None, f"{key}_high": None}
        elif isinstance(value, Mapping):
            row |= {f"{key}_{name}": part for name, part in value.items()}
        else:
            row[key] = value
    return row
