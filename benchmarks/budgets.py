"""What selectors with a budget make of a problem whose answer is known.

    python benchmarks/budgets.py

A free policy succeeds half of the time; one for a cent succeeds 0.4 more often on half of the instances, 0.05 on the others. The best is to spend all
cents on the first half. The gain counted is that in probability of success, learning included. One JSON line a budget and selector.
"""

import argparse
import json

import numpy as np

from osel_sim.selection.budget import Budget, Budgeted
from osel_sim.selection.registry import make_selector

PACES = (0.25, 0.05)
"""Cents a decision."""
DIM = 4


def played(name: str, pace: float, decisions: int, seed: int) -> tuple[float, float, float]:
    """Share of the optimum's gain, share of the cents spent, and mean price of a cent over the last quarter."""
    chance = np.random.default_rng([7, seed])
    good = chance.integers(2, size=decisions)
    contexts = (np.eye(DIM)[good] + 0.1 * chance.normal(size=(decisions, DIM))).astype(np.float32)
    rates = {"local": np.full(decisions, 0.5), "remote": np.where(good, 0.9, 0.55)}
    prices = {"local": 0.0, "remote": 1.0}
    cents = pace * decisions
    selector = Budgeted(make_selector(name, tuple(prices), DIM, seed), Budget(cents, decisions, prices), DIM, seed)
    gained, duals = 0.0, []
    for decision, context in enumerate(contexts):
        choice = selector.select(context)
        rate = rates[choice.policy][decision]
        selector.pay(choice.policy, prices[choice.policy])
        selector.update(context, choice, float(chance.random() < rate))
        gained += float(rate) - 0.5
        duals.append(selector.dual)
    return gained / (0.4 * cents), selector.total / cents, float(np.mean(duals[3 * decisions // 4 :]))


def main() -> None:
    """Print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--selectors", nargs="+", default=["auto", "epsilon_greedy"])
    parser.add_argument("--decisions", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    for pace in PACES:
        for name in options.selectors:
            found = np.mean([played(name, pace, options.decisions, seed) for seed in range(options.seeds)], axis=0).round(3).tolist()
            print(json.dumps({"cents_a_decision": pace, "selector": name} | dict(zip(("gain", "spent", "price"), found, strict=True))), flush=True)


if __name__ == "__main__":
    main()
