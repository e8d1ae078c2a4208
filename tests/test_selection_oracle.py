"""Oracles on a table small enough to check by hand."""

import numpy as np
import pytest

from osel_sim.core.errors import DataError
from osel_sim.selection.oracle import compare

REWARDS = [[1.0, 0.5], [0.0, 0.5], [1.0, 0.8], [0.0, 0.4]]
CHOSEN = [0, 0, 1, 1]


def test_by_hand():
    result = compare(REWARDS, CHOSEN)
    assert result.instances == 4
    assert (result.best_single, result.best_single_reward) == (1, pytest.approx(0.55))
    assert result.hindsight_oracle == pytest.approx((1 + 0.5 + 1 + 0.4) / 4)
    assert result.received == pytest.approx((1 + 0 + 0.8 + 0.4) / 4)
    assert result.regret == pytest.approx(0.7 / 4)


def test_missing_outcomes_are_left_out_and_counted():
    rewards = [*REWARDS, [np.nan, 9.0]]
    result = compare(rewards, [*CHOSEN, 1])
    assert result == compare(REWARDS, CHOSEN)


def test_ties_go_to_the_first():
    assert compare([[1.0, 0.0], [0.0, 1.0]], [0, 1]).best_single == 0


@pytest.mark.parametrize("rewards", [[], [[np.nan, 1.0]], [1.0, 2.0]])
def test_nothing_to_compare(rewards):
    with pytest.raises(DataError):
        compare(rewards, [0] * len(rewards))
