"""Oracles and bounds on problems with known answers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_log import clusters, make_row, write_log

from osel_sim.analysis.gains import Gain, gain_of
from osel_sim.analysis.log import LoggedInstance, LoggedOutcomes, read_log
from osel_sim.analysis.measures import Curves, difference_ends, gap_closed
from osel_sim.analysis.oracles import expected_oracle, oracles
from osel_sim.analysis.remembered import fingerprint
from osel_sim.analysis.streams import complete_instances, draw_streams
from osel_sim.core.errors import DataError, UsageError
from osel_sim.selection.reward import RewardWeights
from osel_sim.statistics.betting import advantage_bounds

FREE = RewardWeights(0.0, 0.0)


def test_order_and_truth(tmp_path: Path):
    """hindsight > truth >= expected and predictable > best single; the two come near the truth with many repeats and instances."""
    made = clusters(tmp_path, instances=1500, clusters=6, dim=8, policies=3, repeats=12, seed=3)
    log = read_log(tmp_path)
    found = oracles(log, FREE)
    hindsight = log.rewards(FREE)[:, :, 0].max(axis=1).mean()
    assert found.learnable == "expected" and found.expected is not None
    assert hindsight > made.oracle + 0.1
    assert made.best_single + 0.05 < found.expected.mean() < made.oracle + 0.02
    assert found.predictable.mean() == pytest.approx(made.oracle, abs=0.02)
    assert set(found.router) == {"first", "second"} and "one policy for all" not in found.router.values()
    assert oracles(log.take(log.half("score")), FREE).predictable.mean() == pytest.approx(made.oracle, abs=0.03)
    assert log.mean_rewards(FREE)[:, found.best_single].mean() == pytest.approx(made.best_single, abs=0.02)
    for few in (1, 2, 3):  # as in a run that has just begun: halves may be empty
        assert np.isfinite(oracles(log.take(np.arange(few)), FREE).predictable).all()


def test_what_was_computed_of_a_log_is_remembered_until_anything_in_it_differs(tmp_path: Path):
    log = read_log(clusters(tmp_path / "log", instances=60, clusters=3, dim=4, policies=2).folder)
    found = oracles(log, FREE)
    assert oracles(replace(log, source=tmp_path), FREE) is found
    other = replace(log, success=np.where(np.arange(60)[:, None, None] == 7, 1.0 - log.success, log.success))
    moved, turned = replace(log, contexts=log.contexts + 1), log.take(np.arange(60)[::-1])
    for changed in (other, moved, turned, log.only(log.policies[::-1])):
        assert fingerprint(changed) != fingerprint(log) and oracles(changed, FREE) is not found
    assert oracles(log, RewardWeights(0.1, 0.0)) is not found and oracles(log, FREE) is found


def test_luck_is_not_foresight():
    coins = (np.random.default_rng(0).random((4000, 2, 2)) < 0.5).astype(float)
    assert coins[:, :, 0].max(axis=1).mean() > 0.7
    value, _ = expected_oracle(coins, np.zeros(4000))
    assert value.mean() == pytest.approx(0.5, abs=0.03)
    assert expected_oracle(coins[:, :, :1], np.zeros(4000)) is None


def test_repeats_on_a_tenth_stand_for_all():
    """Whatever the reference, the mean is near that with repeats everywhere; a good one makes it surer, and the spread of the gains says how sure."""
    generator = np.random.default_rng(4)
    rates = generator.choice([0.1, 0.9], (6000, 2))
    rewards = (generator.random((6000, 2, 4)) < rates[:, :, None]).astype(float)
    truth = expected_oracle(rewards, np.zeros(6000))[0].mean()
    assert truth - rewards.mean(axis=(0, 2)).max() > 0.15
    references = {"poor": rewards[:, 0, 0], "good": rates.max(axis=1)}
    estimates = {name: [] for name in references}
    for _ in range(100):
        some = np.where((generator.random(6000) < 0.1)[:, None, None] | (np.arange(4) == 0), rewards, np.nan)
        for name, reference in references.items():
            value, gains = expected_oracle(some, reference)
            estimates[name].append((value.mean(), np.nanstd(gains) / np.isfinite(gains).sum() ** 0.5))
    spread = {}
    for name, found in estimates.items():
        means, errors = np.transpose(found)
        assert means.mean() == pytest.approx(truth, abs=0.005)
        assert errors.mean() == pytest.approx(means.std(), rel=0.3)
        spread[name] = means.std()
    assert spread["good"] < 0.7 * spread["poor"]


def test_the_interval_of_the_gap_closed_counts_what_the_oracle_may_be_off():
    flat, order = np.zeros((5, 40)), np.tile(np.arange(40, dtype=np.int32), (5, 1))
    gains = {"expected": Gain(1.0, 0.1)}
    known = {"best_single": flat, "expected": flat + 1.0}
    sure = Curves({"x": flat + 0.5}, known, "expected", order, np.arange(40), 0.0, gains, {})
    unsure = replace(sure, expected_error=0.1)
    assert gap_closed(sure.selectors["x"], sure, "expected", 0) == (0.5, (0.5, 0.5))
    share, (low, high) = gap_closed(unsure.selectors["x"], unsure, "expected", 0)
    assert share == 0.5 and (low, high) == pytest.approx((0.4, 0.6), abs=0.003)  # two standard errors of the gap, of which it is half
    assert difference_ends(unsure, "expected", flat + 1.0) == pytest.approx((0.8, 1.2), abs=0.005)
    assert difference_ends(unsure, "best_single", flat) == [0.0, 0.0]


def test_groups_that_tell_nothing_are_not_used(tmp_path: Path):
    generator = np.random.default_rng(1)
    rows = [
        make_row(f"i{row}", policy, target=f"t{row % 40}", success=bool(generator.random() < rate))
        for row in range(400)
        for policy, rate in (("a", 0.7), ("b", 0.4))
    ]
    log = read_log(write_log(tmp_path, rows, {f"i{row}": np.ones(2, np.float32) for row in range(400)}))
    found = oracles(log, FREE)
    assert found.learnable == "predictable"
    best = log.mean_rewards(FREE)[:, 0].mean()
    assert best - 0.05 < found.predictable.mean() <= best + 1e-9


TRUTHS = ("linear", "clusters", "either or", "groups", "texts")


@pytest.mark.parametrize("truth", TRUTHS)
def test_what_other_instances_tell_is_found(truth: str):
    """One of two policies succeeds at .9 and the other at .2: which is which is in the context, in a label or in the text; best single: .55."""
    generator = np.random.default_rng(5)
    contexts = generator.normal(size=(1000, 8))
    kind = generator.integers(20, size=1000)
    first = {
        "linear": contexts @ generator.normal(size=8) > 0.0,
        "clusters": kind % 2 == 0,
        "either or": (contexts[:, 0] > 0.0) != (contexts[:, 1] > 0.0),
        "groups": kind % 2 == 0,
        "texts": kind % 2 == 0,
    }[truth]
    if truth == "clusters":
        contexts = contexts * 0.2 + generator.normal(size=(20, 8))[kind]
    if truth == "either or":
        contexts[:, 2:] *= 0.1
    rates = np.where(first[:, None], (0.9, 0.2), (0.2, 0.9))
    log = made(contexts, generator, rates, target=kind if truth == "groups" else None, instruction=kind if truth == "texts" else None)
    found = oracles(log, FREE)
    assert 0.55 + 0.2 < found.predictable.mean() < 0.9 + 0.02, found.router


def test_repeated_texts_tell_as_much_as_all_their_rows() -> None:
    """Sixty questions in ten rows each: a selector that reads them has seen nine rows of a text at the end, and must not pass the oracle."""
    generator, ahead = np.random.default_rng(3), []
    for _ in range(5):
        kind = np.repeat(np.arange(60), 10)
        rates = np.where(generator.random(60)[kind, None] < 0.5, (0.8, 0.4), (0.4, 0.8))
        log = made(np.eye(64)[kind], generator, rates, instruction=kind)
        found, means = oracles(log, FREE), log.mean_rewards(FREE)
        sums = np.stack([np.bincount(kind, weights=column) for column in means.T], axis=1)[kind] - means
        reader = means[np.arange(600), (sums + 4.0 * means.mean(axis=0)).argmax(axis=1)]
        assert "groups by instruction" in found.routed
        ahead.append(found.predictable.mean() - reader.mean())
    assert np.mean(ahead) > -0.01


def test_what_tells_nothing_gains_nothing():
    """Whatever the rates and the contexts' length: never beyond its error, and on average the best single policy's reward."""
    apart, beyond = [], 0
    for seed in range(20):
        generator = np.random.default_rng(seed)
        rates = np.tile(generator.uniform(0.3, 0.7, 3), (400, 1))
        log = made(generator.normal(size=(400, (8, 64)[seed % 2])), generator, rates, target=generator.integers(9, size=400))
        means = log.mean_rewards(FREE)
        found = oracles(log, FREE)
        gain = gain_of(np.arange(400, dtype=np.int32)[None], (found.predictable - means[:, found.best_single])[None], np.arange(400))
        apart.append(gain.mean)
        beyond += gain.beyond_error()
    assert beyond <= 1 and -0.015 < np.mean(apart) <= 0.005


def made(contexts: np.ndarray, generator: np.random.Generator, rates: np.ndarray, **labels: np.ndarray | None) -> LoggedOutcomes:
    """A log of successes at known rates (N, P); labels as texts."""
    count, policies = rates.shape
    success = (generator.random(rates.shape) < rates)[:, :, None].astype(float)
    nothing = np.full(success.shape, np.nan)
    told = {name: [f"{name} {value}" for value in values] for name, values in labels.items() if values is not None}
    instances = tuple(LoggedInstance(f"i{row}", "made", **{name: values[row] for name, values in told.items()}) for row in range(count))
    names = tuple(f"p{column}" for column in range(policies))
    measures = dict.fromkeys(("subgoals", "score", "steps", "upload", "inference", "download", "motion", "price"), nothing)
    context = contexts.astype(np.float32)
    flags = {name: np.zeros(success.shape, bool) for name in ("errors", "fallbacks", "solved_by_fallback")}
    return LoggedOutcomes(Path("made"), instances, names, context, "made@1", success, **measures, **flags, metadata={})


def test_only_complete_instances_are_streamed(tmp_path: Path):
    rows = [make_row(f"i{row}", policy, repeat) for row in range(5) for policy in "ab" for repeat in range(2)]
    rows = [row for row in rows if not (row.instance == "i1" and row.policy == "b")]
    rows += [make_row("i5", "a"), make_row("i5", "b", success=False, error="died")]
    log = read_log(write_log(tmp_path, rows, {f"i{row}": np.ones(2, np.float32) for row in range(6)}))
    complete, left_out = complete_instances(log, FREE)
    assert complete.keys == ("i0", "i2", "i3", "i4")
    assert (left_out.instances, left_out.by_policy, left_out.errors) == (2, {"a": 0, "b": 2}, 1)
    with pytest.raises(DataError, match="oracles need"):
        oracles(log, FREE)
    with pytest.raises(DataError, match=r"none of 2 instances.*a on 2, b on 0"):
        complete_instances(log.take([1, 5]), FREE)


def test_streams_are_permutations_with_valid_repeats():
    rewards = np.random.default_rng(0).random((30, 2, 3))
    rewards[::2, 1, 1] = np.nan
    streams = draw_streams(rewards, (0, 1, 5))
    assert streams.order.shape == (3, 30) and streams.repeats.shape == (3, 30, 2)
    assert all(sorted(order) == list(range(30)) for order in streams.order.tolist())
    assert np.isfinite(streams.rewards(rewards, 0)).all() and set(np.unique(streams.repeats)) == {0, 1, 2}
    shorter = draw_streams(rewards, (5,), decisions=7)
    assert (shorter.order[0] == streams.order[2][:7]).all() and (shorter.repeats[0] == streams.repeats[2][:7]).all()
    with pytest.raises(UsageError, match="has 30 instances"):
        draw_streams(rewards, (0,), 31)


def test_bounds_hold_and_narrow():
    generator = np.random.default_rng(0)
    wrong, widths = 0, []
    for _ in range(300):
        differences = generator.choice([-1.0, 0.0, 1.0], p=[0.15, 0.6, 0.25], size=(1, 800))
        low, high = advantage_bounds(differences, 1.0, 0.05)
        wrong += (low > 0.1) + (high < 0.1)
        widths.append(high - low)
    assert wrong <= 0.1 * 300 + 15
    assert np.mean(widths) < 0.2
    # Copies of one order are no new evidence: the bounds stay what they were.
    assert advantage_bounds(np.repeat(differences, 20, axis=0), 1.0, 0.05) == pytest.approx((low, high))
    assert advantage_bounds(np.full((2, 3), 0.5), 1.0, 0.05) == (-1.0, 1.0)  # three decisions say nothing


def test_bounds_hold_while_it_learns():
    """The advantage grows from -0.2 to 0.2: what is bounded is its mean over the decisions, 0."""
    generator = np.random.default_rng(1)
    rate = np.linspace(0.4, 0.6, 1000)
    wrong = 0
    for _ in range(200):
        low, _ = advantage_bounds(np.where(generator.random(1000) < rate, 1.0, -1.0), 1.0, 0.05)
        wrong += low > 0.0
    assert wrong <= 15


def test_wrong_input_to_bounds():
    for bad in ([], [np.nan], [2.0]):
        with pytest.raises(UsageError):
            advantage_bounds(bad, 1.0, 0.05)
    with pytest.raises(UsageError):
        advantage_bounds([0.1], 1.0, 0.0)
