"""A replay from choices to `replay.json`: everything measured, and the tables."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from osel_sim.analysis.log import LoggedOutcomes
from osel_sim.analysis.measures import curves, measure_selector, oracle_interval, paired
from osel_sim.analysis.oracles import Oracles
from osel_sim.analysis.streams import LeftOut
from osel_sim.analysis.verdict import reward_span, verdict
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


def build(
    log: LoggedOutcomes, weights: RewardWeights, preset: str | None, choices: Choices, best: Oracles, left_out: LeftOut, seeds: Sequence[int]
) -> dict[str, Any]:
    """What `replay.json` holds.

    Args:
        log: the instances of `choices`, in its order.
        preset: name of the paper's weights, where they are that.
        choices: with the fixed policies (`with_fixed`).

    Returns:
        log (folder, instances, left_out, policies, repeats, encoder, tasks), reward, seeds, decisions, selectors, oracles, learnable_oracle, paired,
        verdict, and frontier, which is None until it is replayed (`osel_sim.analysis.frontier`). Each selector has a `kind`: `learner`, `random` or
        `fixed` (with its `policy`).
    """
    rewards = curves(log, weights, choices, best)
    policies = choices.policies
    singles = {BEST: policies[best.best_single], WORST: policies[best.worst_single]}
    selectors = {name: {**kind(name, singles), **measure_selector(log, choices, rewards, name)} for name in choices.chosen}
    learners = [name for name, entry in selectors.items() if entry["kind"] == "learner"]
    return {
        "log": {
            "folder": str(log.source),
            "tasks": sorted(set(log.labels("task"))),
            "instances": len(log),
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
        "oracles": {
            name: {
                "mean_reward": float(values.mean()),
                "ci95": list(oracle_interval(rewards, name, choices.order)),
                "mean_reward_late": float(values[:, rewards.late :].mean()),
                "gain": rewards.gains[name].mean,
                "gain_ci95": rewards.gains[name].ends,
            }
            for name, values in rewards.oracles.items()
        },
        "learnable_oracle": {
            "name": rewards.learnable,
            "repeated": len(best.expected_gains),
            "router": best.router,
            "beaten": dict(rewards.beaten),
        },
        "paired": paired(rewards, [*learners, *(name for name, entry in selectors.items() if entry["kind"] == "random"), BEST]),
        "verdict": verdict(rewards, learners, selectors, policies[best.best_single], reward_span(log.rewards(weights))),
        "frontier": None,
    }


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
