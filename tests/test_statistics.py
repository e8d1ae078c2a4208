"""Intervals against published values and their own promise: coverage."""

import numpy as np
import pytest

from osel_sim.core.errors import UsageError
from osel_sim.statistics.best import best_of_each, probability_of_best, share_of_best
from osel_sim.statistics.intervals import bootstrap_mean_interval, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "interval"),
    # Newcombe (1998), "Two-sided confidence intervals for the single proportion", table I, method 3.
    [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611)), (1, 29, (0.0061, 0.1718)), (29, 29, (0.8830, 1.0))],
)
def test_wilson_as_published(successes, trials, interval):
    assert wilson_interval(successes, trials) == pytest.approx(interval, abs=6e-5)


def test_wilson_edges():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(0, 7)[0] == 0.0 and wilson_interval(7, 7)[1] == 1.0
    narrow, wide = wilson_interval(5, 10, 0.5), wilson_interval(5, 10, 0.99)
    assert wide[0] < narrow[0] < 0.5 < narrow[1] < wide[1]
    for bad in ((-1, 5), (6, 5)):
        with pytest.raises(UsageError, match="successes"):
            wilson_interval(*bad)
    with pytest.raises(UsageError, match="confidence"):
        wilson_interval(1, 2, 1.0)


def test_bootstrap_covers_the_mean():
    generator = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        low, high = bootstrap_mean_interval(generator.normal(2.0, 1.0, size=40), resamples=500)
        covered += low <= 2.0 <= high
    assert 0.88 <= covered / 200 <= 0.99


def test_bootstrap_is_seeded_and_near_the_normal_interval():
    values = np.random.default_rng(1).normal(size=400)
    assert bootstrap_mean_interval(values, seed=3) == bootstrap_mean_interval(values, seed=3)
    assert bootstrap_mean_interval(values, seed=3) != bootstrap_mean_interval(values, seed=4)
    half = 1.96 * values.std() / 20
    assert bootstrap_mean_interval(values) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.01)
    assert bootstrap_mean_interval([0.5]) == (0.5, 0.5)


@pytest.mark.parametrize("values", [[], [1.0, np.nan]])
def test_bootstrap_needs_values(values):
    with pytest.raises(UsageError, match="finite"):
        bootstrap_mean_interval(values)


@pytest.mark.parametrize(
    ("means", "deviations"),
    [
        ([0.1, 0.0, 0.3], [0.2, 0.5, 0.002]),  # one deviation a hundredth of another
        ([0.1, 0.3, 0.25, -2.0], [0.3, 0.1, 0.2, 0.3]),
    ],
)
def test_probability_of_best_is_the_frequency_among_draws(means, deviations):
    draws = np.random.default_rng(0).normal(means, deviations, size=(200_000, len(means))).argmax(axis=1)
    found = probability_of_best(np.array(means), np.array(deviations))
    assert found == pytest.approx(np.bincount(draws, minlength=len(means)) / len(draws), abs=0.005)
    assert found.sum() == pytest.approx(1.0)


def test_probability_of_best_of_equals_and_of_what_is_certain():
    assert probability_of_best(np.zeros(4), np.ones(4)) == pytest.approx([0.25] * 4)
    assert probability_of_best(np.array([1.0, 1.0, 0.0]), np.zeros(3)).tolist() == [0.5, 0.5, 0.0]
    assert probability_of_best(np.array([-3.0]), np.ones(1)).tolist() == [1.0]


def test_equal_columns_share_a_row_and_rows_with_gaps_do_not_count():
    table = np.array([[1.0, 0.3 - 0.1, 1.0], [0.0, 0.2, 0.1 + 0.1], [0.0, np.nan, 5.0], [3.0, 1.0, 2.0]])
    assert share_of_best(table) == pytest.approx([1.5 / 3, 0.5 / 3, 1.0 / 3])
    assert best_of_each(table).tolist() == [[True, False, True], [False, True, True], [False, False, False], [True, False, False]]
    assert np.isnan(share_of_best(table[2:3])).all()
