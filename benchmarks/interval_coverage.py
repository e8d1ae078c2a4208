"""How often the intervals of off-policy estimates hold the truth, by how many effective decisions they rest on.

    python benchmarks/interval_coverage.py [--runs 100] [--decisions 1000] [--first-seed 0]

A simulated run: two policies, each good in one of two kinds of contexts, chosen between by `auto` (with its floor, and with a higher one),
`thompson`, `lints` and `random`. From its propensities three targets are estimated: always the first policy, both equally often, and the better one
by a linear model of the decisions so far; their truth is known.
The last line is JSON: bracket of effective decisions -> estimator -> (estimates, coverage).
"""

import argparse
import json
from itertools import pairwise

import numpy as np

from osel_sim.analysis.off_policy import LEAST_EFFECTIVE, WAYS, OffPolicyEstimate, estimate, forward_model, greedy
from osel_sim.core.progress import progress
from osel_sim.selection.registry import make_selector

RATES = np.array([[0.75, 0.35], [0.35, 0.75]])
LOGGERS: tuple[tuple[str, dict[str, float]], ...] = (("auto", {}), ("auto", {"floor": 1.0}), ("thompson", {}), ("lints", {}), ("random", {}))
BRACKETS = (0.0, 10.0, 30.0, LEAST_EFFECTIVE, 300.0, float("inf"))


def simulate(name: str, settings: dict[str, float], seed: int, decisions: int) -> list[tuple[OffPolicyEstimate, float]]:
    """Estimates of the three targets, each with its truth."""
    generator = np.random.default_rng([seed, 1])  # a seed of its own: with the selector's, contexts and choices would go together
    kinds = generator.integers(2, size=decisions)
    contexts = (np.eye(8)[kinds] + 0.3 * generator.normal(size=(decisions, 8))).astype(np.float32)
    success = (generator.random((decisions, 2)) < RATES[kinds]).astype(np.float64)
    selector = make_selector(name, ("first", "second"), 8, seed, **settings)
    chosen, propensities = np.zeros(decisions, np.int64), np.zeros((decisions, 2))
    for row, context in enumerate(contexts):
        choice = selector.select(context)
        chosen[row], propensities[row] = choice.policy == "second", list(choice.propensities.values())
        selector.update(context, choice, float(success[row, chosen[row]]))
    rewards = success[np.arange(decisions), chosen]
    model = forward_model(contexts, rewards, chosen, 2)
    targets = (np.tile([1.0, 0.0], (decisions, 1)), np.full((decisions, 2), 0.5), greedy(model))
    return [(estimate(rewards, chosen, propensities, target, model), float((target * RATES[kinds]).sum(axis=1).mean())) for target in targets]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="of each selector")
    parser.add_argument("--decisions", type=int, default=1000, help="of a run; every other has half as many")
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    held: dict[tuple[int, str], list[bool]] = {}
    with progress(options.runs * len(LOGGERS), "run", "coverage") as bar:
        for name, settings in LOGGERS:
            for seed in range(options.first_seed, options.first_seed + options.runs):
                for found, truth in simulate(name, settings, seed, options.decisions // (1 + seed % 2)):
                    for way in WAYS:
                        interval = getattr(found, f"{way}_ci95")
                        if interval is not None:
                            bracket = int(np.searchsorted(BRACKETS, getattr(found, f"{way}_effective"), side="right")) - 1
                            held.setdefault((bracket, way), []).append(interval[0] <= truth <= interval[1])
                bar.update(1)
    result = {}
    for bracket, (low, high) in enumerate(pairwise(BRACKETS)):
        own = {way: held.get((bracket, way), []) for way in WAYS}
        result[f"{low:g} to {high:g}"] = {way: (len(values), round(float(np.mean(values)), 3) if values else None) for way, values in own.items()}
        cells = "  ".join(f"{way} {np.mean(values):6.1%} of {len(values)}" for way, values in own.items() if values)
        print(f"{low:5g} to {high:5g} effective decisions: {cells}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
