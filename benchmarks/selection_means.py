"""How `auto` explores policies' means: its rule without context, simulated for hundreds of seeds at once.

    python benchmarks/selection_means.py [--seeds 400] [--bounds]

Policies of fixed success rates. For each rule the mean regret per 1000 decisions and the share of stuck seeds (most of the last quarter on a policy
worse by more than 0.05), over all problems and on some of them. The last line is JSON: rule -> problem -> (regret, share stuck).

With `--bounds` what can be reached instead: on each problem `auto`'s rule beside one that is told the rates, but not whose they are, and with 16
policies in 400 decisions those that spend the first so many on finding out which is best, whatever that costs. The last line is JSON likewise.
"""

import argparse
import json
from collections.abc import Callable
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from osel_sim.selection.bayesian import FEW

Array = NDArray[np.float64]
Rule = Callable[[Array, Array, np.random.Generator], NDArray[np.int64]]
"""Of decisions and successes of each policy, (S, P) each: the choices (S,)."""

PROBLEMS: tuple[tuple[tuple[float, ...], int, int], ...] = (
    ((0.02, 0.05), 1000, 0),
    ((0.1, 0.12), 1000, 0),
    ((0.3, 0.7), 300, 0),
    ((0.5, 0.6), 1000, 0),
    ((0.64, 0.86), 1000, 0),
    ((0.64, 0.86), 1000, 3),
    ((0.8, 0.9), 600, 0),
    ((0.95, 0.99), 1000, 0),
    ((0.1, 0.1, 0.2), 1000, 0),
    ((0.4, 0.5, 0.6), 1500, 0),
    ((0.2, 0.3, 0.4, 0.5), 600, 0),
    ((), 400, 0),
    ((), 1500, 0),
)
"""Rates (none: 16 are drawn), decisions, and how many of the first decisions fail where they are the best policy's."""


def gaussian(chance: float, optimism: float, *, few: float = FEW, floor: float = 0.1, slow: float = 0.0) -> Rule:
    """`auto`'s rule where no context helps.

    Args:
        slow: chance grows until there are so many decisions a policy.
    """

    def choose(counts: Array, successes: Array, generator: np.random.Generator) -> NDArray[np.int64]:
        total = counts.sum(axis=1, keepdims=True)
        overall = successes.sum(axis=1, keepdims=True) / np.maximum(total, 1)
        means = np.where(counts > 0, (successes + overall) / (counts + 1), 0.0)
        centre = means.sum(axis=1, keepdims=True) / np.maximum((counts > 0).sum(axis=1, keepdims=True), 1)
        spread = np.sqrt(np.maximum(overall * (1 - 2 * centre) + centre**2, 0.0))
        spread = np.where((overall <= 0.0) | (overall >= 1.0), 0.5, spread)
        rates = successes / np.maximum(counts, 1)
        within = (counts * rates * (1 - rates)).sum(axis=1, keepdims=True)
        unit = np.sqrt((4 * spread**2 + within) / (4 + total))
        variances = 1 / (counts + 1)
        own = chance * (min(1.0, float(np.sqrt(total[0, 0] / counts.shape[1] / slow))) if slow else 1.0)
        drawn = own * np.sqrt(variances * (1 + few * counts / (counts + 1) ** 2)) * generator.normal(size=counts.shape)
        choices = (centre + (successes - counts * centre) / (counts + 1) + unit * (optimism * np.sqrt(variances) + drawn)).argmax(axis=1)
        random = generator.random(len(counts)) < np.minimum(0.5, floor / np.sqrt(total[:, 0] + 1))
        return np.where(random, generator.integers(counts.shape[1], size=len(counts)), choices)

    return choose


def beta(counts: Array, successes: Array, generator: np.random.Generator) -> NDArray[np.int64]:
    """Thompson sampling from the exact posterior of a success rate."""
    return np.asarray(generator.beta(1 + successes, 1 + counts - successes).argmax(axis=1), np.int64)


def told(rates: tuple[float, ...]) -> Rule:
    """Knows the rates, and draws whose they are from its belief to the fifth power, which wastes less than the belief itself."""
    orders = np.array(sorted(set(permutations(rates))))

    def choose(counts: Array, successes: Array, generator: np.random.Generator) -> NDArray[np.int64]:
        likely = successes @ np.log(orders).T + (counts - successes) @ np.log(1 - orders).T
        shares = np.exp(5 * (likely - likely.max(axis=1, keepdims=True))).cumsum(axis=1)
        drawn = (shares < generator.random((len(counts), 1)) * shares[:, -1:]).sum(axis=1)
        return np.asarray(orders[drawn].argmax(axis=1), np.int64)

    return choose


def finds_out(first: int) -> Rule:
    """Top-two Thompson sampling (Russo 2016) for the first decisions, the best by what it found from then on; it knows how rates are drawn."""

    def choose(counts: Array, successes: Array, generator: np.random.Generator) -> NDArray[np.int64]:
        if counts[0].sum() >= first:
            return np.asarray(((successes + 2) / (counts + 4)).argmax(axis=1), np.int64)
        draws = generator.beta(2 + successes, 2 + counts - successes, (2, *counts.shape))
        best = draws[0].argmax(axis=1)
        draws[1, np.arange(len(best)), best] = -1.0
        return np.where(generator.random(len(best)) < 0.5, best, draws[1].argmax(axis=1))

    return choose


RULES: dict[str, Rule] = {
    "auto: chance 0.4, optimism 1": gaussian(0.4, 1.0),
    "chance 0.7, no optimism": gaussian(0.7, 0.0),
    "chance 0.4, no optimism": gaussian(0.4, 0.0),
    "chance 0.3, optimism 0.7": gaussian(0.3, 0.7),
    "no chance, optimism 1, no floor": gaussian(0.0, 1.0, floor=0.0),
    "chance grows to 25 decisions a policy": gaussian(0.4, 1.0, slow=25.0),
    "twice as much chance for few decisions": gaussian(0.4, 1.0, few=2 * FEW),
    "exact posterior": beta,
}


def simulate(rule: Rule, rates: tuple[float, ...], decisions: int, unlucky: int, seeds: int) -> tuple[float, float]:
    """Mean regret, and the share of stuck seeds."""
    generator = np.random.default_rng([decisions, unlucky, *(int(100 * rate) for rate in rates)])
    each = np.tile(rates, (seeds, 1)) if rates else generator.beta(2, 2, (seeds, 16))
    counts, successes, rows = np.zeros_like(each), np.zeros_like(each), np.arange(seeds)
    regret, late = np.zeros(seeds), np.zeros(seeds)
    for decision in range(decisions):
        chosen = rule(counts, successes, generator)
        success = generator.random(seeds) < each[rows, chosen]
        if decision < unlucky:
            success &= chosen != each.argmax(axis=1)
        counts[rows, chosen] += 1
        successes[rows, chosen] += success
        lost = each.max(axis=1) - each[rows, chosen]
        regret += lost
        late += (lost > 0.05 + 1e-9) * (decision >= decisions * 3 // 4)
    return float(regret.mean()), float((late > decisions / 8).mean())


def bounds(seeds: int) -> None:
    """Print what can be reached; see the module."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    print("| problem | decisions | 1% of the best single | auto's rule | told the rates |\n|---|---|---|---|---|")
    for rates, decisions, unlucky in PROBLEMS:
        if rates and not unlucky:
            own = {
                name: simulate(rule, rates, decisions, 0, seeds)
                for name, rule in (("auto", RULES["auto: chance 0.4, optimism 1"]), ("told", told(rates)))
            }
            found[f"{rates} {decisions}"] = own
            print(
                f"| {' '.join(map(str, rates))} | {decisions} | {max(rates) * decisions / 100:.1f} | {own['auto'][0]:.1f} | {own['told'][0]:.1f} |",
                flush=True,
            )
    print("\n| 16 policies, 400 decisions | regret | stuck |\n|---|---|---|")
    rules = {
        "auto's rule": RULES["auto: chance 0.4, optimism 1"],
        **{f"the first {first} to find out": finds_out(first) for first in (100, 200, 300)},
    }
    found["16 policies"] = {name: simulate(rule, (), 400, 0, seeds) for name, rule in rules.items()}
    for name, (regret, stuck) in found["16 policies"].items():
        print(f"| {name} | {regret:.1f} | {stuck:.1%} |")
    print(json.dumps(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--bounds", action="store_true")
    options = parser.parse_args()
    if options.bounds:
        bounds(options.seeds)
        return
    found: dict[str, dict[str, tuple[float, float]]] = {}
    print("| rule | regret per 1000 | stuck | of 0.5, 0.6 | of an unlucky start | of 16 policies, 400 decisions |\n|---|---|---|---|---|---|")
    for name, rule in RULES.items():
        own = {f"{rates} {decisions} {unlucky}": simulate(rule, rates, decisions, unlucky, options.seeds) for rates, decisions, unlucky in PROBLEMS}
        found[name] = {problem: (round(regret, 3), round(stuck, 4)) for problem, (regret, stuck) in own.items()}
        each = np.mean([1e3 * regret / decisions for (regret, _), (_, decisions, _) in zip(own.values(), PROBLEMS, strict=True)])
        some = " | ".join(f"{own[problem][1]:.1%}" for problem in ("(0.5, 0.6) 1000 0", "(0.64, 0.86) 1000 3", "() 400 0"))
        print(f"| {name} | {each:.1f} | {np.mean([stuck for _, stuck in own.values()]):.1%} | {some} |", flush=True)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
