"""The reward of an outcome, by hand."""

import math
from dataclasses import replace

import pytest

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.outcome import Outcome, Seconds
from osel_sim.selection.reward import FLOOR_SECONDS, PRESETS, RewardWeights, preset, reward, total_seconds

REMOTE = Outcome(True, 0.75, 200, Seconds(upload=1.0, inference=2.0, download=0.5, motion=10.0), calls=4, actions=120, price=8.0)


def test_by_hand():
    assert reward(REMOTE, RewardWeights(0.2, 0.01)) == pytest.approx(1 - 0.2 * math.log10(10.0) - 0.01 * 8)
    assert reward(REMOTE, RewardWeights(0.001, 0.01, "steps")) == pytest.approx(1 - 0.2 - 0.08)
    assert reward(REMOTE, RewardWeights(0.1, 0.01, "log10-steps")) == pytest.approx(1 - 0.1 * math.log10(200) - 0.08)
    assert reward(REMOTE, RewardWeights(0.0, 0.0, success="subgoals")) == 0.75
    assert reward(replace(REMOTE, success=False), RewardWeights(0.0, 0.0)) == 0.0


def test_waiting_is_not_counted_twice():
    assert total_seconds(**vars(REMOTE.seconds)) == 10.0
    assert total_seconds(upload=1.0, inference=2.0, download=0.5, motion=0.0) == 3.5  # nothing moves: a logged answer


def test_no_time_at_all_counts_as_one_control_step():
    nothing = replace(REMOTE, seconds=Seconds())
    assert reward(nothing, RewardWeights(1.0, 0.0)) == pytest.approx(1 - math.log10(FLOOR_SECONDS))
    assert reward(replace(nothing, steps=0), RewardWeights(1.0, 0.0, "log10-steps")) == 1.0


def test_a_success_pays_by_every_preset():
    assert all(0.0 < reward(REMOTE, weights) < 1.0 for weights in PRESETS.values())


def test_presets_of_the_paper():
    assert {name: (weights.alpha_time, weights.alpha_price) for name, weights in PRESETS.items()} == {
        "mmlu": (0.03, 0.0008),
        "waymo": (0.2, 0.001),
        "alfred": (0.05, 0.005),
        "oxe": (0.2, 0.01),
    }
    assert (PRESETS["alfred"].time_unit, PRESETS["alfred"].success) == ("log10-steps", "subgoals")
    assert preset("oxe") is PRESETS["oxe"]
    with pytest.raises(UnknownNameError, match="did you mean 'alfred'"):
        preset("alferd")


@pytest.mark.parametrize("weights", [(-0.1, 0.0), (0.0, -1.0), (math.nan, 0.0), (0.0, math.inf)])
def test_weights_out_of_range(weights):
    with pytest.raises(UsageError, match="must be a finite number >= 0"):
        RewardWeights(*weights)


def test_unknown_words():
    with pytest.raises(UnknownNameError, match="did you mean 'log10-seconds'"):
        RewardWeights(0.1, 0.1, "seconds")
    with pytest.raises(UnknownNameError, match="did you mean 'subgoals'"):
        RewardWeights(0.1, 0.1, success="subgoal")


def test_what_a_fallback_did_alone_is_no_success_of_the_policy():
    """Else a policy whose server is dead would be as good as its fallback, and dearer."""
    weights = RewardWeights(0.2, 0.01)
    charged = -0.2 * math.log10(10.0) - 0.01 * 8
    alone = replace(REMOTE, actions=0, fallback="closed the connection", fallback_steps=180)
    assert reward(alone, weights) == pytest.approx(charged)
    assert reward(alone, RewardWeights(0.0, 0.0, success="subgoals")) == 0.0
    assert reward(replace(alone, actions=8), weights) == pytest.approx(1 + charged)  # it led there


def test_an_error_has_no_reward():
    with pytest.raises(UsageError, match="server died"):
        reward(replace(REMOTE, error="server died"), PRESETS["oxe"])
