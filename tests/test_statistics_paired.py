"""Paired comparisons against published values, and their own promises: coverage, error under the null, power."""

import numpy as np
import pytest

from osel_sim.core.errors import UsageError
from osel_sim.statistics.paired import (
    Discordance,
    holm,
    letters,
    mcnemar_midp,
    mean_interval,
    score_interval,
    sign_flip_midp,
    success_interval,
)


@pytest.mark.parametrize(
    ("gained", "lost", "probability"),
    [
        (7, 1, 10 / 256),  # Fagerland, Lydersen and Laake (2013), Bentur's airways: .039
        (1, 7, 10 / 256),
        (0, 0, 1.0),
        (4, 4, 1.0),
        (5, 0, 1 / 32),
    ],
)
def test_mcnemar_midp_as_published(gained, lost, probability):
    assert mcnemar_midp(gained, lost) == pytest.approx(probability)
    assert mcnemar_midp(16, 6) == pytest.approx(0.035, abs=6e-4)  # the same, responses to chemotherapy


@pytest.mark.parametrize(
    ("gained", "lost", "exact"),  # p of the exact test without mid-p, by statsmodels 0.15's mcnemar
    [(7, 1, 0.0703125), (16, 6, 0.052478790283203125), (5, 0, 0.0625), (30, 18, 0.11140289106101878), (3, 12, 0.03515625)],
)
def test_mcnemar_midp_is_the_exact_test_less_half_of_what_was_seen(gained, lost, exact):
    from scipy.stats import binom, binomtest

    assert binomtest(gained, gained + lost).pvalue == pytest.approx(exact)
    assert mcnemar_midp(gained, lost) == pytest.approx(exact - binom.pmf(min(gained, lost), gained + lost, 0.5))


@pytest.mark.parametrize(("gained", "lost", "pairs"), [(1, 7, 21), (9, 3, 40), (20, 20, 300), (0, 4, 50), (0, 0, 30)])
def test_the_ends_of_the_score_interval_are_where_the_score_test_says(gained, lost, pairs):
    """Tango's test again, with the likelihood under a difference maximised by SciPy instead of in closed form."""
    from scipy.optimize import minimize_scalar
    from scipy.special import xlogy

    for end in score_interval(gained, lost, pairs):

        def unlikely(share: float, end: float = end) -> float:  # `share`: probability of a loss
            rest = max(1.0 - 2.0 * share - end, 0.0)
            return -float(xlogy(gained, max(share + end, 0.0)) + xlogy(lost, share) + xlogy(pairs - gained - lost, rest))

        found = minimize_scalar(unlikely, bounds=(max(0.0, -end), (1.0 - end) / 2.0), method="bounded", options={"xatol": 1e-12})
        variance = (2.0 * found.x + end - end * end) / pairs
        assert abs((gained - lost) / pairs - end) / np.sqrt(variance) == pytest.approx(1.959964, abs=2e-3)


def test_score_interval_as_published():
    # Fagerland, Lydersen and Laake (2014), Bentur's airways: 1 and 7 of 21 pairs, Tango's interval.
    assert score_interval(1, 7, 21) == pytest.approx((-0.517, -0.026), abs=6e-4)


def test_score_interval_of_few_pairs_has_a_width_and_is_symmetric():
    low, high = score_interval(0, 0, 20)
    assert low == pytest.approx(-high) and high == pytest.approx(1.96**2 / (20 + 1.96**2), abs=1e-3)
    assert score_interval(5, 0, 5)[1] == pytest.approx(1.0) and score_interval(0, 5, 5)[0] == -1.0
    one, other = score_interval(3, 9, 40), score_interval(9, 3, 40)
    assert one == pytest.approx((-other[1], -other[0]))
    for bad in ((-1, 0, 5), (3, 3, 5), (0, 0, 0)):
        with pytest.raises(UsageError, match="discordant"):
            score_interval(*bad)


def test_whole_differences_give_mcnemar_and_tango_and_repeats_narrow_the_interval():
    whole = np.array([1.0] * 9 + [-1.0] * 3 + [0.0] * 28)
    assert sign_flip_midp(whole) == mcnemar_midp(9, 3)
    assert success_interval(whole) == pytest.approx(score_interval(9, 3, 40))
    low, high = success_interval(whole / 3.0, most=120)
    assert high - low < 0.6 * np.subtract(*success_interval(whole)[::-1])


def test_sign_flips_of_fractions_agree_with_all_signs():
    values = np.array([1 / 3, 2 / 3, -1 / 3, 1.0, 1 / 3, 0.0, 2 / 3, 1 / 3, -2 / 3])
    signs = np.array(np.meshgrid(*[[-1, 1]] * len(values))).reshape(len(values), -1)
    sums, seen = np.abs(values @ signs), abs(values.sum())
    exact = (sums > seen + 1e-9).mean() + 0.5 * np.isclose(sums, seen).mean()
    assert sign_flip_midp(values) == pytest.approx(exact, abs=0.005)
    assert sign_flip_midp(values) == sign_flip_midp(values)


def paired_sample(generator, pairs, both, gained, lost, repeats=1):
    """Differences of success (pairs,); with repeats each instance has rates of its own around those."""
    cells = generator.choice(4, size=pairs, p=[both, gained, lost, 1.0 - both - gained - lost])
    first, second = np.isin(cells, (0, 2)).astype(float), np.isin(cells, (0, 1)).astype(float)
    if repeats == 1:
        return second - first
    rates = 0.1 + 0.8 * np.stack([first, second])
    draws = generator.binomial(repeats, rates) / repeats
    return draws[1] - draws[0]


@pytest.mark.parametrize(
    ("pairs", "gained", "lost", "repeats"), [(50, 0.1, 0.1, 1), (200, 0.12, 0.04, 1), (30, 0.3, 0.2, 1), (150, 0.15, 0.05, 3), (400, 0.02, 0.02, 1)]
)
def test_success_interval_covers(pairs, gained, lost, repeats):
    generator = np.random.default_rng([pairs, repeats])
    true = (gained - lost) * (1.0 if repeats == 1 else 0.8)
    inside = 0
    for _ in range(1500):
        low, high = success_interval(paired_sample(generator, pairs, 0.4, gained, lost, repeats), most=pairs * repeats)
        inside += low <= true <= high
    assert 0.93 <= inside / 1500 <= 0.97


@pytest.mark.parametrize(("pairs", "repeats"), [(30, 1), (120, 1), (60, 3)])
def test_equal_columns_are_told_apart_in_5_of_100_at_most(pairs, repeats):
    generator = np.random.default_rng([7, pairs, repeats])
    found = [sign_flip_midp(paired_sample(generator, pairs, 0.4, 0.12, 0.12, repeats), draws=2000) <= 0.05 for _ in range(2000)]
    assert np.mean(found) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 2000)


def test_planned_instances_find_the_difference():
    generator = np.random.default_rng(3)
    pilot = paired_sample(generator, 2000, 0.5, 0.12, 0.06)
    needed = Discordance.of(pilot).instances(0.06)
    found = [sign_flip_midp(paired_sample(generator, needed, 0.5, 0.12, 0.06)) <= 0.05 for _ in range(1000)]
    assert 0.76 <= np.mean(found) <= 0.86
    # Connor (1987): (1.96 sqrt(.2) + .8416 sqrt(.2 - .01))^2 / .01 = 154.3
    assert Discordance(0.2, 1.0).instances(0.1) == 155
    with pytest.raises(UsageError, match="difference"):
        Discordance(0.2, 1.0).instances(0.0)


def test_no_discordance_in_a_few_does_not_stand_for_none():
    assert Discordance.of(np.zeros(10)).share == pytest.approx(1 / 12)


def test_mean_interval_is_students():
    from scipy.stats import ttest_1samp

    values = np.random.default_rng(5).exponential(size=25) - 0.7
    expected = ttest_1samp(values, 0.0).confidence_interval()
    assert mean_interval(values) == pytest.approx((expected.low, expected.high))
    assert mean_interval([1.0]) is None and mean_interval([0.5] * 9) is None


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []
    assert holm([0.01, 0.04, 0.03, 0.005, 0.2]) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.2])  # statsmodels 0.15's multipletests


def test_letters_are_shared_by_those_not_told_apart():
    assert letters(["x", "y", "z"], []) == {"x": "a", "y": "a", "z": "a"}
    assert letters(["x", "y", "z"], [("x", "z")]) == {"x": "a", "y": "ab", "z": "b"}
    assert letters(["x", "y", "z"], [("x", "z"), ("x", "y"), ("y", "z")]) == {"x": "a", "y": "b", "z": "c"}


def test_letters_say_exactly_what_was_told_apart():
    generator = np.random.default_rng(2)
    for _ in range(50):
        names = [f"p{index}" for index in range(6)]
        pairs = [(one, other) for index, one in enumerate(names) for other in names[index + 1 :]]
        different = [pair for pair in pairs if generator.random() < 0.4]
        found = letters(names, different)
        assert {pair for pair in pairs if not set(found[pair[0]]) & set(found[pair[1]])} == set(different)
        assert all(found.values())
