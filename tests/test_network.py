import math

import numpy as np
import pytest

from osel_sim.core.errors import UnknownNameError
from osel_sim.formats.policy_file import NETWORKS
from osel_sim.remote.network import PROFILES, Delays, NetworkModel, NetworkProfile, profile

UP, DOWN = 60_000, 2_000


def draw(profile_, seed, calls=20):
    model = NetworkModel(profile_, seed)
    return [model.delays(UP, 0.1, DOWN) for _ in range(calls)]


def many(profile_, count=4000):
    return [NetworkModel(profile_, (7, index)).delays(UP, 0.1, DOWN) for index in range(count)]


def test_there_is_a_profile_for_every_name_a_policy_file_may_use():
    assert set(PROFILES) == set(NETWORKS)
    with pytest.raises(UnknownNameError, match="did you mean 'wifi'"):
        profile("wfi")


def test_delays_depend_on_seed_and_call_only():
    first = draw(PROFILES["lte"], (3, 1, 0))
    assert first == draw(PROFILES["lte"], (3, 1, 0))
    assert len(set(first)) == len(first)
    for other in [(3, 1, 1), (3, 2, 0), (4, 1, 0), (3, 1), (3, 1, 0, 0)]:
        assert first[0] != draw(PROFILES["lte"], other)[0]


def test_known_values_do_not_drift():
    # A journal of today must be reproducible tomorrow: change these only together with a note in the changelog.
    assert NetworkModel(PROFILES["wifi"], (1, 2, 3)).delays(UP, 0.1, DOWN) == Delays(0.036164, 0.100632, 0.011891)


def test_sizes_matter_by_their_bits_and_luck_stays_the_same():
    small = NetworkModel(PROFILES["wifi"], (0,)).delays(1_000, 0.1, DOWN)
    large = NetworkModel(PROFILES["wifi"], (0,)).delays(1_001_000, 0.1, DOWN)
    assert large.upload - small.upload == pytest.approx(8.0 / 20.0, abs=2e-6)
    assert (large.inference, large.download) == (small.inference, small.download)


def test_no_network_takes_no_time():
    delays = many(PROFILES["none"], 200)
    assert all(item.upload == item.download == item.outage == 0 for item in delays)
    assert np.median([item.inference for item in delays]) == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize("name", sorted(PROFILES))
def test_a_call_takes_at_least_light_and_bits(name):
    link = PROFILES[name]
    for item in many(link, 500):
        assert item.upload >= link.round_trip / 2 + 8e-6 * UP / link.uplink - 1e-6
        assert item.download >= link.round_trip / 2 + 8e-6 * DOWN / link.downlink - 1e-6
        assert item.inference > 0
        assert item.total == item.upload + item.inference + item.download
        assert all(math.isfinite(part) for part in (item.upload, item.inference, item.download))


def test_networks_rank_as_everybody_knows():
    medians = [
        np.median([item.upload + item.download for item in many(PROFILES[name], 500)]) for name in ("none", "ethernet", "wifi", "lte", "satellite")
    ]
    assert medians == sorted(medians) and len(set(medians)) == len(medians)


def test_loss_outage_and_jitter_come_as_often_and_as_long_as_the_profile_says():
    lossy = NetworkProfile(math.inf, math.inf, 0.1, loss=0.2)
    waits = np.array([item.upload for item in many(lossy)]) - 0.05
    assert np.mean(waits > 0.001) == pytest.approx(0.2, abs=0.02)
    assert np.mean(waits > 0.31) == pytest.approx(0.04, abs=0.01)  # a second loss waits twice as long
    assert sorted({round(wait, 3) for wait in waits})[:3] == [0.0, 0.3, 0.9]

    breaking = NetworkProfile(math.inf, math.inf, 0.0, outage=0.1, outage_seconds=3.0)
    outages = np.array([item.outage for item in many(breaking)])
    assert np.mean(outages > 0) == pytest.approx(0.1, abs=0.015)
    assert outages[outages > 0].mean() == pytest.approx(3.0, rel=0.15)

    wifi = NetworkProfile(math.inf, math.inf, 0.0, jitter=0.006, jitter_sigma=1.48)
    assert np.percentile([item.upload for item in many(wifi)], [50, 90]) == pytest.approx([0.003, 0.020], rel=0.15)


@pytest.mark.parametrize("wrong", [{"uplink": 0}, {"downlink": -1}, {"loss": 1.0}, {"outage": -0.1}, {"jitter": math.nan}, {"round_trip": math.inf}])
def test_impossible_profiles_are_refused(wrong):
    with pytest.raises(ValueError):
        NetworkProfile(**{"uplink": 1.0, "downlink": 1.0, "round_trip": 0.1, **wrong})
