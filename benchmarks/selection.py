"""How quickly selectors learn where context helps, and what learning costs where it does not: synthetic streams with known answers.

    python benchmarks/selection.py [--selectors auto linucb ...] [--streams 20] [--decisions 2000] [--spread 0.5] [--first-seed 2000]

A stream has 30 clusters of contexts in 512 dimensions, 4 policies at prices from 0 to 0.3 and binary outcomes; each policy has a success rate of its
own in every cluster, drawn uniformly. `gap` is the share of the learnable gap (best policy of each cluster - best single policy, by the true rates)
that was closed, over the first three quarters and in the last; `loss` is what learning cost on streams of one rate a policy, in percent of the
best policy's reward. Settings of `auto` were chosen on streams with seeds below 1000; the default seeds had no part in that.
The last line is JSON: selector -> gap_first, gap_last, loss_percent, milliseconds (of one decision with its update).
"""

import argparse
import json
import time
from dataclasses import dataclass

import numpy as np

from osel_sim.selection.registry import make_selector

CLUSTERS, DIM = 30, 512
PRICES = np.linspace(0.0, 0.3, 4)
POLICIES = tuple(f"policy_{index}" for index in range(len(PRICES)))


@dataclass(frozen=True)
class Stream:
    contexts: np.ndarray  # float32 (decisions, 512)
    expected: np.ndarray  # (decisions, policies) true mean reward
    rewards: np.ndarray  # (decisions, policies) drawn


def make_stream(seed: int, decisions: int, spread: float, informative: bool) -> Stream:
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(CLUSTERS, DIM)) / np.sqrt(DIM)
    rates = generator.random((CLUSTERS, len(PRICES))) if informative else np.tile(generator.beta(2, 2, len(PRICES)), (CLUSTERS, 1))
    cluster = generator.integers(CLUSTERS, size=decisions)
    contexts = centres[cluster] + spread * generator.normal(size=(decisions, DIM)) / np.sqrt(DIM)
    success = generator.random((decisions, len(PRICES))) < rates[cluster]
    return Stream(contexts.astype(np.float32), rates[cluster] - PRICES, success - PRICES)


def replay(name: str, stream: Stream, seed: int) -> np.ndarray:
    """Expected rewards of what was chosen, (decisions,)."""
    settings = {"expected_costs": dict(zip(POLICIES, PRICES.tolist(), strict=True))} if name in ("auto", "kernel_ucb") else {}
    selector = make_selector(name, POLICIES, DIM, seed, **settings)
    received = np.zeros(len(stream.contexts))
    for row, context in enumerate(stream.contexts):
        choice = selector.select(context)
        column = POLICIES.index(choice.policy)
        selector.update(context, choice, float(stream.rewards[row, column]))
        received[row] = stream.expected[row, column]
    return received


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--selectors", nargs="+", default=["auto", "linucb", "lints", "neural_linear", "thompson", "ucb1"])
    parser.add_argument("--streams", type=int, default=20)
    parser.add_argument("--decisions", type=int, default=2000)
    parser.add_argument("--spread", type=float, default=0.5, help="of a cluster, relative to the distance of its centre from the mean")
    parser.add_argument("--first-seed", type=int, default=2000)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.streams)
    last = options.decisions * 3 // 4
    results = {}
    for name in options.selectors:
        won, gap, loss, best = np.zeros(options.decisions), np.zeros(options.decisions), 0.0, 0.0
        start = time.process_time()
        for seed in seeds:
            stream = make_stream(seed, options.decisions, options.spread, informative=True)
            single = stream.expected[:, stream.expected.mean(axis=0).argmax()]
            won += replay(name, stream, seed) - single
            gap += stream.expected.max(axis=1) - single
            stream = make_stream(seed, options.decisions, options.spread, informative=False)
            loss += float((stream.expected.max(axis=1) - replay(name, stream, seed)).sum())
            best += float(stream.expected.max(axis=1).sum())
        results[name] = {
            "gap_first": float(won[:last].sum() / gap[:last].sum()),
            "gap_last": float(won[last:].sum() / gap[last:].sum()),
            "loss_percent": 100.0 * loss / best,
            "milliseconds": 1e3 * (time.process_time() - start) / (2 * options.decisions * options.streams),
        }
        figures = results[name]
        print(
            f"{name:16s} gap closed: first three quarters {figures['gap_first']:6.1%}, last quarter {figures['gap_last']:6.1%}; "
            f"loss without context {figures['loss_percent']:.2f} %; {figures['milliseconds']:.2f} ms",
            flush=True,
        )
    print(json.dumps(results))


if __name__ == "__main__":
    main()
