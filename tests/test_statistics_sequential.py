"""Comparisons that are looked at again and again: their error over all looks together, what they agree with, and how soon they tell."""

import math
from itertools import pairwise

import numpy as np
import pytest

from osel_sim.core.errors import UsageError
from osel_sim.statistics.sequential import anytime_bounds, anytime_p, log_capital, pairs_to_tell

COMPARISONS, PAIRS, ERROR, MARGIN = 1000, 200, 0.05, 0.05
LOOKS = np.arange(10, PAIRS + 1, 10)
WON = math.log(2.0 / ERROR)
"""Each side has half of the error."""


def drawn(generator: np.random.Generator, gained: float, lost: float, repeats: int = 1) -> np.ndarray:
    """Differences (COMPARISONS, PAIRS); with repeats the mean of so many."""
    shape = (COMPARISONS, PAIRS, repeats)
    return generator.choice([1.0, -1.0, 0.0], size=shape, p=[gained, lost, 1.0 - gained - lost]).mean(axis=2)


def told(differences: np.ndarray, below: float) -> np.ndarray:
    """Which comparisons (COMPARISONS,) told at some look that the difference lies above a value."""
    return (log_capital(differences, below)[:, LOOKS - 1] >= WON).any(axis=1)


@pytest.mark.parametrize(("discordant", "repeats"), [(0.02, 1), (0.2, 1), (0.9, 1), (0.3, 3)])
def test_equal_policies_are_told_apart_in_5_of_100_at_most_whenever_one_looks(discordant, repeats):
    differences = drawn(np.random.default_rng([1, int(100 * discordant), repeats]), discordant / 2, discordant / 2, repeats)
    assert (told(differences, 0.0) | told(-differences, 0.0)).mean() <= ERROR


@pytest.mark.parametrize("discordant", [0.05, 0.2, 0.6])
def test_a_policy_worse_by_the_margin_passes_in_half_as_many(discordant):
    differences = drawn(np.random.default_rng([2, int(100 * discordant)]), (discordant - MARGIN) / 2, (discordant + MARGIN) / 2)
    assert told(differences, -MARGIN).mean() <= ERROR / 2


def test_tasks_that_take_turns_and_differ_are_no_false_alarm():
    generator = np.random.default_rng(3)
    up, down = drawn(generator, 0.6, 0.0), drawn(generator, 0.0, 0.6)
    differences = np.where(np.arange(PAIRS) % 2 == 0, up, down)  # better by 60 points on one task, worse by as many on the other
    assert (told(differences, 0.0) | told(-differences, 0.0)).mean() <= ERROR


def test_looking_at_a_test_of_a_fixed_number_again_and_again_is_what_this_is_for():
    from osel_sim.statistics.paired import mcnemar_midp

    differences = drawn(np.random.default_rng(4), 0.15, 0.15)[:100]
    gained, lost = ((differences == sign).cumsum(axis=1)[:, LOOKS - 1] for sign in (1.0, -1.0))
    alarms = [any(mcnemar_midp(*cells) <= ERROR for cells in zip(*pair, strict=True)) for pair in zip(gained.tolist(), lost.tolist(), strict=True)]
    assert np.mean(alarms) > 2 * ERROR


def test_large_differences_are_told_soon():
    differences = drawn(np.random.default_rng(5), 0.3, 0.05)
    ends = (log_capital(differences, 0.0)[:, LOOKS - 1] >= WON).argmax(axis=1)
    assert told(differences, 0.0).mean() > 0.99 and LOOKS[ends].mean() < 60


def test_bounds_are_where_the_capital_says():
    differences = np.random.default_rng(6).choice([1.0, -1.0, 1 / 3, 0.0], size=120, p=[0.3, 0.1, 0.2, 0.4])
    looks = np.arange(0, 121, 10)
    bounds = anytime_bounds(differences, looks, ERROR / 2)
    assert bounds[0] == (-1.0, 1.0)
    assert all(before[0] <= after[0] and before[1] >= after[1] for before, after in pairwise(bounds))
    for value, sign in ((0.0, 1.0), (-0.1, 1.0), (0.5, -1.0)):
        capital = log_capital(sign * differences, sign * value)
        for end, (low, high) in zip(looks[1:], bounds[1:], strict=True):
            won = bool((capital[looks[1:][looks[1:] <= end] - 1] >= WON).any())
            assert won == (low > value if sign > 0 else high < value)
    low, high = bounds[-1]
    assert low > 0.0 and (anytime_p(differences, looks) <= ERROR)
    assert anytime_bounds(-differences, looks, ERROR / 2)[-1] == pytest.approx((-high, -low))


def test_what_is_not_there_tells_nothing_and_ties_tell_equality():
    assert anytime_bounds([], [0], 0.025) == [(-1.0, 1.0)] and anytime_p([], [0]) == anytime_p([0.0] * 50, [50]) == 1.0
    low, high = anytime_bounds(np.zeros(200), [200], 0.025)[0]
    assert low == pytest.approx(-high) and -0.05 < low < 0.0
    assert anytime_bounds(-np.ones(20), [20], 0.025)[0][0] == -1.0
    for call in (
        lambda: anytime_bounds([0.0, math.nan], [2], 0.05),
        lambda: anytime_bounds([0.0, 2.0], [2], 0.05),
        lambda: anytime_bounds([0.0], [2], 0.05),
        lambda: anytime_bounds([0.0, 0.0], [2, 1], 0.05),
        lambda: anytime_bounds([0.0], [1], 1.0),
        lambda: log_capital([0.0], -1.0),
    ):
        with pytest.raises(UsageError):
            call()


def test_the_pairs_that_would_tell_mostly_do():
    generator = np.random.default_rng(7)
    differences = drawn(generator, 0.25, 0.05)
    guess = np.median([pairs_to_tell(sample[:50], 0.0, ERROR / 2) for sample in differences[:200]])
    needed = int(np.median(LOOKS[(log_capital(differences, 0.0)[:, LOOKS - 1] >= WON).argmax(axis=1)]))
    assert 0.6 < guess / needed < 1.8
    assert pairs_to_tell([-1.0, 0.0, 0.0], 0.0, 0.025) == math.inf
