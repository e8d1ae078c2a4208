"""How often the verdict of a replay is right, and how often its intervals hold the truth, on simulated logs of which all is known.

    python benchmarks/verdict.py [--parts coverage stand-in auto] [--logs 500] [--instances 600] [--seeds 20]

A simulated log: eight kinds of instances that contexts tell apart, policies that succeed at known rates on each. *gain g*: two equally good policies,
each better on half of the kinds, so that a router that knows the kinds gains g; *useless*: rates are the same on all kinds; *equal*: and the
same for both policies. Most logs are replayed to a quick stand-in (Thompson sampling on each kind, all seeds at once), those of the
part `auto` to `auto`. The last line is JSON.
"""

import argparse
import json
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.engine import replay_one
from osel_sim.analysis.log import LoggedInstance, LoggedOutcomes
from osel_sim.analysis.oracles import predictable_oracle
from osel_sim.analysis.streamed import Streamed
from osel_sim.analysis.verdict import Played, verdict
from osel_sim.core.progress import progress
from osel_sim.statistics.clustered import unit_mean

PARTS = ["coverage", "stand-in", "auto"]
KINDS, DIM = 8, 16
MARGIN = 0.02
POPULATIONS = {
    "equal": np.full((KINDS, 2), 0.5),
    "useless": np.tile([0.6, 0.5], (KINDS, 1)),
    **{f"gain {gain:.2f}": 0.5 + gain * np.where(np.arange(KINDS)[:, None] % 2 == 0, [1, -1], [-1, 1]) for gain in (0.03, 0.05, 0.1, 0.2)},
    "three": np.array([[0.7, 0.5, 0.3]] * 6 + [[0.5, 0.9, 0.6]] * 2),
}
"""Success rates (kinds, policies)."""


def simulated(rates: NDArray[np.float64], instances: int, generator: np.random.Generator) -> tuple[LoggedOutcomes, NDArray[np.int64]]:
    """A log, and the kind of each instance."""
    kinds = generator.integers(KINDS, size=instances)
    centres = generator.normal(size=(KINDS, DIM))
    contexts = (centres[kinds] + 0.3 * generator.normal(size=(instances, DIM))).astype(np.float32)
    success = (generator.random((instances, rates.shape[1])) < rates[kinds]).astype(np.float64)[:, :, None]
    one, nothing = np.ones_like(success), np.zeros(success.shape, bool)
    times = {name: 0.0 * one for name in ("upload", "inference", "download", "price")} | {"motion": one, "steps": one, "score": np.nan * one}
    named = tuple(LoggedInstance(f"i{row}", "made_up") for row in range(instances))
    policies = tuple(f"policy_{column}" for column in range(rates.shape[1]))
    flags = {name: nothing for name in ("errors", "fallbacks", "solved_by_fallback")}
    log = LoggedOutcomes(Path("simulated"), named, policies, contexts, "made_up@1", success=success, subgoals=success, metadata={}, **times, **flags)
    return log, kinds


def quick(kinds: NDArray[np.int64], rewards: NDArray[np.float64], order: NDArray[np.int32], generator: np.random.Generator) -> NDArray[np.int16]:
    """Columns chosen (S, T) by Thompson sampling on the kinds, which begin at the mean of all; every seed at once."""
    seeds, policies = np.arange(len(order)), rewards.shape[1]
    counts, sums = np.zeros((2, len(order), KINDS, policies))
    chosen = np.zeros(order.shape, np.int16)
    for decision, rows in enumerate(order.T):
        kind = kinds[rows]
        own, total = counts[seeds, kind], counts.sum(axis=1)
        common = (sums.sum(axis=1) + 1.0) / (total + 2.0)
        means = (sums[seeds, kind] + 6.0 * common) / (own + 6.0)
        deviations = 0.35 / np.sqrt(own + 6.0 * total / (total + 6.0) + 0.5)
        columns = (means + deviations * generator.normal(size=means.shape)).argmax(axis=1)
        chosen[:, decision] = columns
        counts[seeds, kind, columns] += 1
        sums[seeds, kind, columns] += rewards[rows, columns]
    return chosen


def replayed(name: str, instances: int, seeds: int, seed: int, slow: bool = False, routed: bool = True) -> tuple[Played, NDArray[np.int64]]:
    """A log of a population with one selector's choices, and the kinds."""
    generator = np.random.default_rng([list(POPULATIONS).index(name), seed, slow])
    log, kinds = simulated(POPULATIONS[name], instances, generator)
    rewards = log.success[:, :, 0]
    order = np.stack([generator.permutation(instances) for _ in range(seeds)]).astype(np.int32)
    if slow:
        chosen = np.stack([replay_one("auto", log.contexts[rows], rewards[rows], log.policies, number) for number, rows in enumerate(order)])
    else:
        chosen = quick(kinds, rewards, order, generator)
    routers = predictable_oracle(log, rewards)[2] if routed else {}
    return Played(log.policies, rewards, np.arange(instances), order, {"auto": chosen}, routers), kinds


def decisions(name: str, logs: int, instances: int, seeds: int, slow: bool = False) -> dict[str, float]:
    """Share of logs of each verdict."""
    found = []
    with progress(logs, "log", name) as bar:
        for seed in range(logs):
            found.append(verdict(replayed(name, instances, seeds, seed, slow)[0], ["auto"], MARGIN)["decision"])
            bar.update(1)
    return {decision: round(found.count(decision) / logs, 3) for decision in ("route", "do_not_route", "not_enough_data")}


def coverage(name: str, logs: int, instances: int, seeds: int) -> dict[str, float]:
    """Share of disjoint parts of simulated logs whose 95 % intervals hold the truth: of a fixed policy, and of the selector, whole and late."""
    rates = POPULATIONS[name]
    means, intervals = [], []
    with progress(logs, "log", name) as bar:
        for seed in range(logs):
            played, _ = replayed(name, instances, seeds, seed, routed=False)
            fixed = unit_mean(played.rewards[:, 0], np.ones(instances))
            parts = [Streamed.of(played.order, played.chosen["auto"], rates.shape[1], first) for first in (0, played.late)]
            found = [fixed, *(part.mean(played.rewards, played.units) for part in parts)]
            means.append([one.mean for one in found])
            intervals.append([one.interval() for one in found])
            bar.update(1)
    # What the selector would come to on average over all logs is known from their mean, to a twentieth of an interval's width.
    truth = np.array([rates[:, 0].mean(), *np.mean(means, axis=0)[1:]])
    ends = np.array(intervals)
    held = ((ends[:, :, 0] <= truth) & (truth <= ends[:, :, 1])).mean(axis=0)
    return dict(zip(("fixed policy", "selector", "selector late"), held.round(3).tolist(), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="intervals, verdicts of the stand-in, verdicts of auto")
    parser.add_argument("--logs", type=int, default=500, help="of each kind")
    parser.add_argument("--instances", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    size = options.instances, options.seeds
    parts = {"coverage": coverage, "stand-in": decisions, "auto": partial(decisions, slow=True)}
    result = {part: {name: parts[part](name, options.logs, *size) for name in POPULATIONS} for part in options.parts}
    for title, found in result.items():
        print(title)
        for name, shares in found.items():
            print(f"  {name:10s}", "  ".join(f"{key} {value:6.1%}" for key, value in shares.items()))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
