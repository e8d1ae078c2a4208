"""Choosing on one half and scoring on the other."""

import numpy as np
import pytest

from osel_sim.analysis.cross_fit import best_of_group, cross_fit

FIRST = np.arange(8) < 4


def test_each_half_is_told_what_the_other_says():
    values = np.array([1.0, 1.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0])
    assert cross_fit(FIRST, lambda by, on: np.full(on.sum(), values[by].mean())).tolist() == [5.0] * 4 + [1.0] * 4


def test_where_one_half_is_empty_both_are_asked_all_the_same():
    asked: list[tuple[int, int]] = []

    def decide(by, on):
        asked.append((by.sum(), on.sum()))
        return np.zeros(on.sum())

    assert len(cross_fit(np.ones(3, bool), decide)) == len(cross_fit(np.zeros(3, bool), decide)) == 3
    assert asked == [(0, 3), (3, 0), (3, 0), (0, 3)]


def test_luck_is_no_foresight_across_halves():
    coins = (np.random.default_rng(0).random((4000, 2)) < 0.5).astype(float)
    groups, first = np.arange(4000) // 4, np.arange(4000) % 2 == 0
    chosen = cross_fit(first, lambda by, on: best_of_group(coins, groups, by, on))
    everyone = np.arange(4000)
    assert coins[everyone, chosen].mean() == pytest.approx(0.5, abs=0.03)
    assert coins[everyone, best_of_group(coins, groups, first | True, first | True)].mean() > 0.58


def test_the_best_of_each_group_and_of_all_where_a_group_is_unknown_or_small():
    rewards = np.array([[1.0, 0.0]] * 4 + [[0.0, 1.0]] * 3 + [[0.0, 0.0]])
    groups = np.array([0, 0, 0, 0, 1, 1, 1, 2])
    by = np.array([True, True, True, True, True, False, False, False])
    assert best_of_group(rewards, groups, by, ~by).tolist() == [1, 1, 0]
    assert best_of_group(rewards, groups, by, ~by, prior=4.0).tolist() == [0, 0, 0]
