"""Analysis of a rollout log, on logs whose answers are known."""

from dataclasses import replace

import numpy as np
import pytest
from report_helpers import FAR, NEAR, WEIGHTS, made_log
from synthetic_log import make_row, write_log

from osel_sim.analysis.clusters import describe, find_clusters, inequality
from osel_sim.analysis.contexts import best_policies, lay_out, wording
from osel_sim.analysis.estimate import rate_of
from osel_sim.analysis.frontier import frontiers
from osel_sim.analysis.log import read_log
from osel_sim.analysis.outcomes import outcome_rates, per_group, remote_policies
from osel_sim.analysis.weights_map import swept, trivial_ranges, weights_map
from osel_sim.core.errors import DataError
from osel_sim.selection.reward import RewardWeights

REMOTE = np.array([False, True])
FREE = RewardWeights(0.0, 0.0)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return made_log(tmp_path_factory.mktemp("log"))


def two_clusters(folder, size=20):
    """In one half of the instances only the local policy succeeds, in the other only the remote one, for 10 cents; everything takes one second."""
    rows, contexts = [], {}
    for number in range(2 * size):
        key, remote_wins = f"made_up/{number}", number >= size
        contexts[key] = np.array([5.0 * remote_wins, 0.01 * number, 0.0])
        rows.append(make_row(key, "local", success=not remote_wins))
        rows.append(make_row(key, "remote", success=remote_wins, upload=0.1, price=10.0))
    return read_log(write_log(folder, rows, contexts))


def test_per_group_counts_and_estimates(log):
    results = per_group(log, WEIGHTS, "target")
    assert [result.group for result in results[::2]] == ["all", "cup", "mug", "pan"]
    everything = next(result for result in results if result.policy == NEAR)
    assert everything.instances == everything.episodes == 120 and everything.errors == 0
    assert everything.success.value == pytest.approx(np.nanmean(log.success[:, 0]))
    assert everything.success.low < everything.success.value < everything.success.high
    pan = next(result for result in results if result.group == "pan" and result.policy == FAR)
    assert pan.price.value == pytest.approx(4.0) and pan.success.value > 0.7


def test_what_did_not_run_is_no_failure(tmp_path):
    rows = [make_row("i0", "a"), make_row("i0", "b", upload=0.1, error="died"), make_row("i1", "a", success=False)]
    log = read_log(write_log(tmp_path, rows, {"i0": np.ones(3), "i1": np.ones(3)}))
    a, b = per_group(log, FREE)
    assert (a.instances, a.success.value) == (2, 0.5)
    assert (b.instances, b.errors, b.success, b.reward) == (0, 1, None, None)
    assert outcome_rates(log, np.array([False, True]))[0].pairs == 0
    assert best_policies(log, FREE) == ("unknown", "unknown")
    with pytest.raises(DataError, match="no instance has an outcome of every policy"):
        inequality(log, np.zeros(2, np.int64), FREE, np.array([False, True]))


def test_repeats_with_other_numbers_are_paired_too(tmp_path):
    rows = [make_row("i0", "a", 0), make_row("i0", "b", 1, success=False, upload=0.1), make_row("i0", "b", 0, upload=0.1, error="died")]
    log = read_log(write_log(tmp_path, rows, {"i0": np.ones(3)}))
    (rates,) = outcome_rates(log, REMOTE)
    assert (rates.pairs, rates.only_local.value) == (1, 1.0)


def test_a_rate_of_nothing_or_all_is_not_certain_with_repeats():
    once, thrice = np.zeros((50, 1)), np.zeros((50, 3))
    thrice[10:, 1:] = np.nan
    assert rate_of(once).high == rate_of(thrice).high == pytest.approx(0.071, abs=0.001)
    generator = np.random.default_rng(0)
    alike = np.repeat(generator.random((400, 1)) < 0.4, 3, axis=1).astype(float)  # repeats that tell nothing new
    fresh = (generator.random((400, 3)) < 0.4).astype(float)  # repeats as good as other instances
    width = {name: rate_of(values).high - rate_of(values).low for name, values in (("alike", alike), ("once", alike[:, :1]), ("fresh", fresh))}
    assert width["alike"] == pytest.approx(width["once"]) and width["fresh"] == pytest.approx(width["once"] / np.sqrt(3), rel=0.1)


def test_remote_policies_are_told_by_network_then_price_then_success(tmp_path):
    assert remote_policies(two_clusters(tmp_path / "network"))[0].tolist() == [False, True]
    rows = [make_row("i", "free", success=False), make_row("i", "paid", price=1.0)]
    found, why = remote_policies(read_log(write_log(tmp_path / "price", rows, {"i": np.ones(2)})))
    assert found.tolist() == [False, True] and "cost money" in why
    rows = [make_row("i", "good"), make_row("i", "bad", success=False)]
    found, why = remote_policies(read_log(write_log(tmp_path / "none", rows, {"i": np.ones(2)})))
    assert found.tolist() == [True, False] and "lowest success" in why


def test_outcome_rates_are_those_of_table_one(tmp_path):
    outcomes = {(True, True): 5, (True, False): 1, (False, True): 3, (False, False): 1}
    rows, contexts = [], {}
    for (local, remote), count in outcomes.items():
        for _ in range(count):
            key = f"i{len(contexts)}"
            contexts[key] = np.ones(2)
            # Two remote policies: a success of any of them counts.
            rows += [make_row(key, "l", success=local), make_row(key, "r1", success=remote), make_row(key, "r2", success=False)]
    (rates,) = outcome_rates(read_log(write_log(tmp_path, rows, contexts)), np.array([False, True, True]))
    assert rates.pairs == 10
    assert [getattr(rates, name).value for name in ("both", "only_local", "only_remote", "neither")] == [0.5, 0.1, 0.3, 0.1]


def test_clusters_are_found_by_silhouette(log):
    clustering = find_clusters(log.contexts)
    assert clustering.count == 3
    targets = np.array(log.labels("target"))
    assert all(len(set(targets[clustering.labels == number])) == 1 for number in range(3))
    clusters = describe(log, clustering, WEIGHTS, REMOTE)
    assert sum(cluster.share for cluster in clusters) == pytest.approx(1.0)
    assert {cluster.about.split(" (")[0]: cluster.best for cluster in clusters}["pan"] == FAR
    assert {cluster.about.split(" (")[0]: cluster.best for cluster in clusters}["cup"] == NEAR
    with pytest.raises(DataError, match="too few"):
        find_clusters(log.contexts[:10])


def test_inequality_by_plain_expectation_and_by_the_papers_formula(tmp_path):
    log = two_clusters(tmp_path)
    labels = np.repeat([0, 1], 20)
    weights = RewardWeights(0.0, 0.02)
    found = inequality(log, labels, weights, REMOTE)
    # Plain: cluster 0 local 1, cluster 1 remote 1 - 0.02 * 10; of all, local 0.5 against remote 0.5 - 0.2.
    assert found.contextual == pytest.approx((1.0 + 0.8) / 2)
    assert found.non_contextual == pytest.approx(0.5)
    assert found.size == pytest.approx(0.4)
    assert found.held_out.value == pytest.approx(0.4)
    # The paper: 1 - p_FS against p_FS - penalty; p_FS is 0 and 1 in the clusters, 0.5 in all.
    assert found.paper_contextual == pytest.approx((1.0 + 0.8) / 2)
    assert found.paper_non_contextual == pytest.approx(max(1 - 0.5, 0.5 - 0.2))


def test_paper_and_plain_differ_where_both_fail_or_both_succeed(tmp_path):
    rows, contexts = [], {}
    for number in range(32):
        contexts[f"i{number}"] = np.array([float(number % 2), 0.0])
        both = number % 2 == 0
        rows += [make_row(f"i{number}", "l", success=both), make_row(f"i{number}", "r", success=both, upload=0.1)]
    log = read_log(write_log(tmp_path, rows, contexts))
    found = inequality(log, np.arange(32) % 2, FREE, REMOTE)
    assert found.contextual == found.non_contextual == pytest.approx(0.5)
    assert found.paper_contextual == found.paper_non_contextual == pytest.approx(1.0)  # counts what both fail as local successes


def test_trivial_ranges_and_map(tmp_path):
    log = two_clusters(tmp_path)
    labels, weights = np.repeat([0, 1], 20), RewardWeights(0.0, 0.01)
    time, price = trivial_ranges(log, labels, weights, REMOTE)
    # At ten cents the remote policy's success is worth it below 0.1 a cent; cluster 0 never wants it.
    assert price.all_remote_below is None
    assert price.all_local_above == pytest.approx(0.1, rel=0.03)
    assert time.all_local_above is None
    found = weights_map(log, labels, weights, REMOTE)
    assert found.remote_share.shape == found.gain.shape == (len(found.alpha_price), len(found.alpha_time))
    low, high = np.searchsorted(found.alpha_price, [0.05, 0.2])
    assert found.remote_share[low, 0] == pytest.approx(0.5) and found.gain[low, 0] == pytest.approx(0.25, abs=0.02)
    assert found.remote_share[high, 0] == 0.0 and found.gain[high, 0] == pytest.approx(0.0)


def test_several_remote_policies_leave_something_to_route(tmp_path):
    """All clusters want a remote policy, but not the same one; by the paper's formula, too, all go remote while it costs little."""
    rows, contexts = [], {}
    for number in range(40):
        contexts[f"i{number}"] = np.array([5.0 * (number < 20), 0.01 * number])
        rows.append(make_row(f"i{number}", "local", success=False))
        rows.append(make_row(f"i{number}", "near", success=number < 20, upload=0.1, price=1.0))
        rows.append(make_row(f"i{number}", "far", success=number >= 20, upload=0.1, price=2.0))
    log = read_log(write_log(tmp_path, rows, contexts))
    _, price = trivial_ranges(log, np.repeat([0, 1], 20), FREE, np.array([False, True, True]))
    assert price.all_remote_below == pytest.approx(0.5, rel=0.05) and price.all_local_above == pytest.approx(1.0, rel=0.05)
    assert [policy for policy, _, _ in price.one_policy] == ["local"] and price.one_policy[0][1] == pytest.approx(1.0, rel=0.05)
    # The paper's local side is 1 - p_FS = 0 on both.
    assert price.paper_all_remote_below == pytest.approx(0.5, rel=0.05)


def test_what_is_not_known_is_not_free(tmp_path):
    """The remote policy's times and prices are known on the second half of the instances only: weights are moved on those alone, or not at all."""
    unknown = {"upload": None, "inference": None, "download": None, "motion": None, "price": None}
    rows, contexts = [], {f"i{number}": np.array([5.0 * (number % 2), 0.01 * number]) for number in range(40)}
    for number in range(40):
        rows.append(make_row(f"i{number}", "local", success=number % 4 == 0))
        rows.append(make_row(f"i{number}", "remote", success=number >= 20, **({"price": 10.0, "motion": 4.0} if number >= 20 else unknown)))
    log, labels = read_log(write_log(tmp_path / "partly", rows, contexts)), np.arange(40) % 2
    part = swept(log, FREE)
    assert part.axes == ("alpha_time", "alpha_price") and part.rows.tolist() == [False] * 20 + [True] * 20
    found = weights_map(log, labels, FREE, REMOTE)
    assert found is not None and np.isfinite(found.gain).all() and found.remote_share[-1, -1] == 0.0
    (hindsight, _), (_, price) = (frontiers(log, labels, FREE, axis, 1.0) for axis in ("alpha_price", "alpha_time"))
    assert hindsight.means["score"][0] == 1.0 and np.isfinite(price.means["price"]).all()
    rows = [replace(row, **unknown) if row.policy == "remote" else row for row in rows]
    none = read_log(write_log(tmp_path / "none", rows, contexts))
    assert swept(none, FREE).axes == () and trivial_ranges(none, labels, FREE, REMOTE) == [] and weights_map(none, labels, FREE, REMOTE) is None


def test_frontier_runs_from_all_success_to_no_price(tmp_path):
    log = two_clusters(tmp_path)
    hindsight, by_cluster = frontiers(log, np.repeat([0, 1], 20), FREE, "alpha_price", 0.3)
    for frontier in (hindsight, by_cluster):
        assert (frontier.means["score"][0], frontier.means["price"][0]) == (1.0, 5.0)
        assert (frontier.means["score"][-1], frontier.means["price"][-1]) == (0.5, 0.0)
        assert (np.diff(frontier.means["price"]) <= 1e-9).all()


def test_contexts_are_laid_out_with_their_labels(log, tmp_path):
    layout = lay_out(log, WEIGHTS, most=60)
    assert layout.places.shape == (60, 2) and np.isfinite(layout.places).all()
    assert set(layout.labels) == {"task", "object", "best policy"}  # container and kind of wording do not differ
    assert np.array_equal(layout.places, lay_out(log, WEIGHTS, most=60).places)
    assert lay_out(log.take(range(5)), WEIGHTS) is None
    assert (wording("train-5"), wording("held_out-2"), wording("plain")) == ("train", "held out", "plain")
