"""Problems with known answers, on which `benchmarks/selection.py` compares selectors."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from osel_sim.selection.skills import Skills

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """One stream: what every policy would get for T decisions.

    Attributes:
        contexts: float32 (T, D).
        expected: (T, P) true mean rewards. Of a real table, whose truth nobody knows, its rewards.
        rewards: (T, P) drawn.
        context_free: whether the context says nothing of the rewards.
        costs: (P,) what selectors are told of the policies' costs.
        skills: what they are told of the policies' skills.
        scale: what one success is worth.
    """

    contexts: NDArray[np.float32]
    expected: Array
    rewards: Array
    context_free: bool = False
    costs: Array | None = None
    skills: Skills | None = None
    scale: float = 1.0


Make = Callable[[np.random.Generator], Problem]


def names(count: int) -> tuple[str, ...]:
    """Of the policies."""
    return tuple(f"policy_{index}" for index in range(count))


def bernoulli(rates: tuple[float, ...], decisions: int, generator: np.random.Generator, dim: int = 64, unlucky: int = 0) -> Problem:
    """Policies of one success rate each, and contexts of noise. No rates: 16 are drawn. The best one fails the first `unlucky` times it is tried."""
    each = np.array(rates) if rates else generator.beta(2, 2, 16)
    contexts = generator.normal(size=(decisions, dim)) / np.sqrt(dim)
    rewards = (generator.random((decisions, len(each))) < each).astype(np.float64)
    rewards[:unlucky, each.argmax()] = 0.0
    return Problem(contexts.astype(np.float32), np.tile(each, (decisions, 1)), rewards, context_free=True)


def useless(decisions: int, dim: int, generator: np.random.Generator) -> Problem:
    """Three policies of drawn rates, and contexts of noise."""
    return bernoulli(tuple(generator.beta(2, 2, 3)), decisions, generator, dim)


def clusters(
    decisions: int,
    generator: np.random.Generator,
    *,
    dim: int = 512,
    count: int = 30,
    strength: float = 1.0,
    dearest: float = 0.0,
    told: int = 0,
    scale: float = 1.0,
    shift: float = 0.0,
    skills: str = "",
) -> Problem:
    """Four policies, each with a success rate of its own in every cluster of contexts.

    Args:
        strength: 1 draws the rates of a cluster anew, 0 leaves every policy one rate.
        dearest: cost of the last policy; the first is free.
        told: 1 tells selectors the costs, -1 tells them in the wrong order.
        skills: "true" declares the clusters a policy is good in, "false" those it is bad in.
    """
    centres = generator.normal(size=(count, dim)) / np.sqrt(dim)
    overall = generator.beta(2, 2, size=(1, 4))
    rates = overall + strength * (generator.random((count, 4)) - overall)
    costs = np.linspace(0.0, dearest, 4)

    def near(cluster: NDArray[np.int64] | int, number: int) -> NDArray[np.float32]:
        return np.asarray(centres[cluster] + 0.5 * generator.normal(size=(number, dim)) / np.sqrt(dim), np.float32)

    cluster = generator.integers(count, size=decisions)
    contexts = near(cluster, decisions)
    success = generator.random((decisions, 4)) < rates[cluster]
    declared = None
    if skills:
        good = rates > 0.5 if skills == "true" else rates < 0.3
        able = {name: tuple(f"skill_{row}" for row in np.flatnonzero(good[:, column])) for column, name in enumerate(names(4))}
        declared = Skills({f"skill_{row}": near(row, 4) for row in range(count)}, able)
    expected, rewards = (scale * (values - costs) + shift for values in (rates[cluster], success))
    return Problem(contexts, expected, rewards, costs=costs[:: told or 1] if told else None, skills=declared, scale=scale)


def linear(decisions: int, strength: float, generator: np.random.Generator, dim: int = 64) -> Problem:
    """Three policies, the log odds of whose success are linear in the context."""
    decay = 1.0 / np.sqrt(np.arange(1, dim + 1))
    contexts = generator.normal(size=(decisions, dim)) * decay
    odds = contexts @ (generator.normal(size=(dim, 3)) * decay[:, None])
    rates = 1.0 / (1.0 + np.exp(-(2.0 * strength * odds / odds.std() + 0.5 * generator.normal(size=3))))
    return _drawn(contexts, rates, generator)


def difficulty(decisions: int, generator: np.random.Generator, dim: int = 128) -> Problem:
    """Contexts are easy or hard for all policies alike, and one policy is a little better everywhere."""
    centres = generator.normal(size=(40, dim)) / np.sqrt(dim)
    rates = 0.9 * generator.random((40, 1)) + np.array([0.0, 0.05, 0.1])
    cluster = generator.integers(40, size=decisions)
    return _drawn(centres[cluster] + 0.3 * generator.normal(size=(decisions, dim)) / np.sqrt(dim), rates[cluster], generator)


def exclusive_or(decisions: int, generator: np.random.Generator) -> Problem:
    """Which of two policies is good depends on whether two numbers of the context have the same sign; a third policy is middling."""
    contexts = generator.normal(size=(decisions, 8)) * np.array([1.0] * 2 + [0.5] * 6)
    same = (contexts[:, 0] * contexts[:, 1] > 0.0)[:, None]
    return _drawn(contexts, np.where(same, [0.85, 0.25, 0.5], [0.25, 0.85, 0.5]), generator)


def drift(decisions: int, generator: np.random.Generator, dim: int = 64) -> Problem:
    """One policy becomes worse while another becomes better; the context says nothing of it."""
    along = np.linspace(0.0, 1.0, decisions)
    rates = np.stack([0.7 - 0.4 * along, 0.4 + 0.3 * along, np.full(decisions, 0.45)], axis=1)
    return _drawn(generator.normal(size=(decisions, dim)) / np.sqrt(dim), rates, generator)


def change(decisions: int, generator: np.random.Generator, dim: int = 64) -> Problem:
    """Halfway the best of three policies becomes the worst; the context says nothing of it."""
    rates = np.where(np.arange(decisions)[:, None] < decisions // 2, [0.8, 0.6, 0.4], [0.3, 0.6, 0.4])
    return _drawn(generator.normal(size=(decisions, dim)) / np.sqrt(dim), rates, generator)


def changed(
    before: tuple[float, ...], after: tuple[float, ...], decisions: int, generator: np.random.Generator, at: float = 0.5, dim: int = 64
) -> Problem:
    """Rates before and after a moment that nobody announces, in shares of the stream; the context says nothing of it."""
    rates = np.where(np.arange(decisions)[:, None] < at * decisions, before, after)
    return _drawn(generator.normal(size=(decisions, dim)) / np.sqrt(dim), rates, generator)


def clusters_swapped(decisions: int, generator: np.random.Generator) -> Problem:
    """Halfway two of the policies change places in every cluster of contexts."""
    problem = clusters(decisions, generator, dim=64, count=10)
    late, places = np.arange(decisions) >= decisions // 2, [1, 0, 2, 3]
    tables = (np.where(late[:, None], table[:, places], table) for table in (problem.expected, problem.rewards))
    return Problem(problem.contexts, *tables)


def repeats(texts: int, each: int, generator: np.random.Generator, dim: int = 128) -> Problem:
    """The same few contexts again and again, with rates of their own."""
    contexts = generator.normal(size=(texts, dim)) / np.sqrt(dim)
    rates = 0.6 * generator.random((texts, 2)) + np.array([0.2, 0.3])
    order = generator.permutation(np.repeat(np.arange(texts), each))
    return _drawn(contexts[order], rates[order], generator)


def _drawn(contexts: Array, rates: Array, generator: np.random.Generator) -> Problem:
    rates = np.clip(rates, 0.0, 1.0)
    return Problem(contexts.astype(np.float32), rates, (generator.random(rates.shape) < rates).astype(np.float64))


PROBLEMS: dict[str, Make] = {
    **{
        f"bernoulli {' '.join(map(str, rates)) or '16 policies'}{', unlucky' if unlucky else ''}": partial(
            bernoulli, rates, decisions, unlucky=unlucky
        )
        for rates, decisions, unlucky in (
            ((0.02, 0.05), 1000, 0),
            ((0.3, 0.7), 300, 0),
            ((0.5, 0.6), 1000, 0),
            ((0.64, 0.86), 1000, 0),
            ((0.64, 0.86), 1000, 3),
            ((0.8, 0.9), 600, 0),
            ((0.95, 0.99), 1000, 0),
            ((0.5, 0.55), 5000, 0),
            ((0.1, 0.1, 0.2), 1000, 0),
            ((0.4, 0.5, 0.6), 1500, 0),
            ((0.9, 0.95, 0.99), 3000, 0),
            ((), 400, 0),
        )
    },
    "useless context, 32 numbers": partial(useless, 1000, 32),
    "useless context, 1000 numbers": partial(useless, 1000, 1000),
    "linear": partial(linear, 1500, 1.0),
    "linear, weak": partial(linear, 1500, 0.3),
    "difficulty": partial(difficulty, 1500),
    "clusters, 300 decisions": partial(clusters, 300),
    "clusters": partial(clusters, 1500),
    "clusters, weak": partial(clusters, 1500, strength=0.3),
    "clusters, 10,000 decisions": partial(clusters, 10_000, dim=64),
    "clusters, rewards / 10": partial(clusters, 1500, scale=0.1),
    "clusters, rewards x 30 + 10": partial(clusters, 1500, scale=30.0, shift=10.0),
    "clusters, costs dominate": partial(clusters, 1500, dearest=0.6, told=1),
    "clusters, wrong costs": partial(clusters, 1500, dearest=0.3, told=-1),
    "clusters, skills": partial(clusters, 800, count=10, skills="true"),
    "clusters, false skills": partial(clusters, 1500, count=10, skills="false"),
    "exclusive or": partial(exclusive_or, 2000),
    "drift": partial(drift, 2000),
    "change": partial(change, 2000),
    "swap": partial(changed, (0.8, 0.3, 0.5), (0.3, 0.8, 0.5), 2000),
    "one gets worse": partial(changed, (0.78, 0.6, 0.5), (0.51, 0.6, 0.5), 2000, at=0.4),
    "one gets better": partial(changed, (0.6, 0.4, 0.3), (0.6, 0.9, 0.3), 3000, at=0.33),
    "clusters, swap": partial(clusters_swapped, 3000),
    "repeated texts": partial(repeats, 60, 20),
}
