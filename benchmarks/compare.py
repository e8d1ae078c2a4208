"""How often `compare` is wrong: coverage of its intervals and error rates of its answers, on made-up logs whose truth is known.

    python benchmarks/compare.py [--runs 2000]

Two policies on 10 to 1,000 instances, with one or three repeats, equally good, worse by exactly the margin, by more, and better; with success in
about half of the episodes, hardly ever, nearly always, and never but alike. A claim is wrong if it says better of a policy that is not, worse of one
that is not, or no worse of one that is worse by the margin or more. The last line is JSON: kind -> "instances x repeats" -> coverage of the interval
of success, of Student's of a skewed cost, shares of the four answers, and share of wrong claims; then the same of recordings until decided.
"""

import argparse
import functools
import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from osel_sim.analysis.comparison import compare_pairs
from osel_sim.analysis.pairing import Contender, Pairs
from osel_sim.analysis.until_decided import ERROR
from osel_sim.core.progress import progress
from osel_sim.statistics.paired import mean_interval
from osel_sim.statistics.sequential import log_capital

MARGIN = 0.05
SIZES, REPEATS = (10, 20, 50, 200, 1000), (1, 3)
ANSWERS = ("better", "no worse", "worse", "not enough data")


@dataclass(frozen=True)
class Kind:
    """How two policies compare: shares of instances that both solve, that only the second does, that only the first does.

    Attributes:
        noise: with which probability an episode turns out otherwise than the instance says.
    """

    both: float
    gained: float
    lost: float
    noise: float = 0.0

    @property
    def difference(self) -> float:
        """The true difference of success."""
        return (1.0 - 2.0 * self.noise) * (self.gained - self.lost)


def noisy(kind: Kind) -> Kind:
    """The same difference where an episode of an instance is not like the next: what repeats are for."""
    return Kind(kind.both, kind.gained / 0.9, kind.lost / 0.9, 0.05)


KINDS = {
    "equal": Kind(0.4, 0.1, 0.1),
    "equal, hardly ever": Kind(0.01, 0.02, 0.02),
    "equal, nearly always": Kind(0.95, 0.02, 0.02),
    "alike": Kind(0.5, 0.0, 0.0),
    "worse by the margin": Kind(0.4, 0.075, 0.125),
    "worse by the margin, nearly always": Kind(0.94, 0.0, 0.05),
    "worse": Kind(0.4, 0.05, 0.2),
    "better": Kind(0.4, 0.2, 0.05),
}


def drawn(kind: Kind, instances: int, repeats: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Success of both policies, means over repeats, (2, instances)."""
    cells = generator.choice(4, size=instances, p=[kind.both, kind.gained, kind.lost, 1.0 - kind.both - kind.gained - kind.lost])
    rates = np.abs(np.stack([np.isin(cells, (0, 2)), np.isin(cells, (0, 1))]) - kind.noise)
    return np.asarray(generator.binomial(repeats, rates) / repeats)


@functools.cache
def answer(counts: tuple[tuple[float, float, int], ...], repeats: int) -> tuple[str, float, float]:
    """The decision on so many instances of each outcome, and the 95% interval of success: they depend on nothing else."""
    first, second = (np.repeat([values[side] for values in counts], [values[2] for values in counts]) for side in (0, 1))
    contenders = [Contender(name, name, None) for name in ("before", "after")]  # type: ignore[arg-type]  # of a log that is not asked for
    names = ("",) * len(first)
    pairs = Pairs(*contenders, names, names, {"success": first}, {"success": second}, len(first) * repeats, 0, 0, (0, 0), {})
    found = compare_pairs(pairs, MARGIN)
    return found["verdict"]["decision"], *found["differences"]["success"]["ci95"]


def simulate(kind: Kind, instances: int, repeats: int, runs: int, seed: int = 0) -> dict[str, float]:
    """Shares of made-up logs in which each thing was said, and in which intervals held the truth."""
    generator = np.random.default_rng([seed, instances, repeats])
    said, held, costs = dict.fromkeys(ANSWERS, 0), 0, 0
    for _ in range(runs):
        both = drawn(kind, instances, repeats, generator)
        values, counts = np.unique(both.round(9), axis=1, return_counts=True)
        decision, low, high = answer(tuple((*pair, count) for pair, count in zip(values.T.tolist(), counts.tolist(), strict=True)), repeats)
        said[decision] += 1
        held += low <= kind.difference <= high
        ends = mean_interval(generator.lognormal(sigma=0.7, size=instances) - generator.lognormal(sigma=0.7, size=instances))
        costs += ends is not None and ends[0] <= 0.0 <= ends[1]
    true = {"better": kind.difference > 1e-9, "worse": kind.difference < -1e-9, "no worse": kind.difference > -MARGIN + 1e-9}
    wrong = sum(said[name] for name, holds in true.items() if not holds)
    return {"coverage": held / runs, "coverage_cost": costs / runs, **{name: said[name] / runs for name in ANSWERS}, "wrong": wrong / runs}


def sequential(kind: Kind, instances: int, runs: int, seed: int = 0) -> dict[str, float]:
    """The same of recordings that are looked at after every ten instances, and where they stop on average."""
    generator = np.random.default_rng([seed, instances])
    both = np.stack([drawn(kind, instances, 1, generator) for _ in range(runs)])
    differences, looks, won = both[:, 1] - both[:, 0], np.arange(9, instances, 10), np.log(2.0 / ERROR)
    told = {
        "better": log_capital(differences, 0.0)[:, looks] >= won,
        "no worse": log_capital(differences, -MARGIN)[:, looks] >= won,
        "worse": log_capital(-differences, 0.0)[:, looks] >= won,
    }
    true = {"better": kind.difference > 1e-9, "worse": kind.difference < -1e-9, "no worse": kind.difference > -MARGIN + 1e-9}
    wrong = np.any([told[name].any(axis=1) for name, holds in true.items() if not holds] or [np.zeros(runs, bool)], axis=0)
    ended = told["no worse"] | told["worse"]
    stopped = np.where(ended.any(axis=1), 10 * (ended.argmax(axis=1) + 1), instances)
    return {"decided": float(ended.any(axis=1).mean()), "wrong": float(wrong.mean()), "instances": float(stopped.mean())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="instances")
    parser.add_argument("--runs", type=int, default=2000, help="made-up logs of each kind and size; a tenth where there are repeats")
    options = parser.parse_args()
    result: dict[str, dict[str, dict[str, float]]] = {}
    with progress(len(KINDS) * len(options.sizes) * (len(REPEATS) + 1), "size", "compare") as bar:
        for name, kind in KINDS.items():
            own = result[name] = {}
            for size in options.sizes:
                for repeats in REPEATS:
                    like = kind if repeats == 1 else noisy(kind)
                    own[f"{size} x {repeats}"] = simulate(like, size, repeats, options.runs if repeats == 1 else max(options.runs // 10, 1))
                    bar.update(1)
                own[f"{size} until decided"] = sequential(kind, size, min(options.runs, 1000))
                bar.update(1)
    for name, sizes in result.items():
        print(name)
        for size, found in sizes.items():
            print(f"  {size:20}" + "  ".join(f"{key} {value:.3f}" if value <= 1.0 else f"{key} {value:.0f}" for key, value in found.items()))
    rounded = {name: {size: {key: round(value, 4) for key, value in own.items()} for size, own in sizes.items()} for name, sizes in result.items()}
    print(json.dumps(rounded))


if __name__ == "__main__":
    main()
