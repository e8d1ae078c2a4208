"""Off-policy estimates on a problem whose answer is known."""

import numpy as np
import pytest

from osel_sim.analysis.off_policy import estimate, forward_model, greedy
from osel_sim.core.errors import UsageError

RATES = np.array([[0.9, 0.3], [0.2, 0.6]])  # by kind of instance and policy
VALUES = RATES.mean(axis=0)


def problem(seed: int, decisions: int = 600):
    """A run that mostly chooses policy 0 for either kind. -> contexts, rewards received, chosen, propensities."""
    generator = np.random.default_rng(seed)
    kind = generator.integers(2, size=decisions)
    contexts = np.eye(2)[kind] + 0.1 * generator.normal(size=(decisions, 2))
    propensities = np.where(kind[:, None] == 0, [0.8, 0.2], [0.7, 0.3])
    chosen = (generator.random(decisions) > propensities[:, 0]).astype(int)
    rewards = (generator.random(decisions) < RATES[kind, chosen]).astype(float)
    return contexts.astype(np.float32), rewards, chosen, propensities


@pytest.mark.parametrize("policy", [0, 1])
def test_unbiased_with_honest_intervals(policy):
    names, found, covered, widths = ("ips", "snips", "dr"), [], [], []
    for seed in range(120):
        contexts, rewards, chosen, propensities = problem(seed)
        target = np.zeros_like(propensities)
        target[:, policy] = 1.0
        result = estimate(rewards, chosen, propensities, target, forward_model(contexts, rewards, chosen, 2))
        found.append([getattr(result, name) for name in names])
        intervals = np.array([getattr(result, f"{name}_ci95") for name in names])
        covered.append((intervals[:, 0] <= VALUES[policy]) & (VALUES[policy] <= intervals[:, 1]))
        widths.append(intervals[:, 1] - intervals[:, 0])
    assert np.abs(np.mean(found, axis=0) - VALUES[policy]).max() < 4 * np.std(found, axis=0).max() / np.sqrt(120)
    assert np.mean(covered, axis=0).min() > 0.88
    ips, _, dr = np.mean(widths, axis=0)
    assert dr < 0.9 * ips


def test_greedy_by_the_model_beats_every_single_policy():
    contexts, rewards, chosen, propensities = problem(0, 3000)
    model = forward_model(contexts, rewards, chosen, 2)
    result = estimate(rewards, chosen, propensities, greedy(model), model)
    assert result.dr == pytest.approx(0.75, abs=0.06) and result.dr_ci95[0] > VALUES.max()


def test_no_prediction_knows_its_own_reward():
    contexts, rewards, chosen, _ = problem(0, 200)
    before = forward_model(contexts, rewards, chosen, 2)
    changed = rewards.copy()
    changed[100:] = 7.0
    assert (forward_model(contexts, changed, chosen, 2)[:101] == before[:101]).all()


def test_nothing_is_said_about_what_could_not_have_been_chosen():
    propensities = np.array([[1.0, 0.0], [0.5, 0.5]])
    result = estimate([1.0, 0.0], [0, 1], propensities, [[0.0, 1.0], [0.0, 1.0]])
    assert result.unsupported == 0.5 and result.ips is None and result.dr_ci95 is None
    same = estimate([1.0, 0.0], [0, 1], propensities, propensities)
    assert same.ips == same.snips == same.dr == 0.5 and same.effective_decisions == 2.0
    assert result.few == same.few == ("ips", "snips", "dr")


def test_each_estimate_says_on_how_many_decisions_it_rests():
    """400 decisions, each policy as likely as the other; the second was chosen in 320 of them, and always paid 0.5."""
    chosen = np.repeat([0, 1], [80, 320])
    propensities, target = np.full((400, 2), 0.5), np.tile([0.0, 1.0], (400, 1))
    result = estimate(np.full(400, 0.5), chosen, propensities, target)
    assert (result.ips, result.snips, result.mean_weight) == pytest.approx((0.8, 0.5, 1.6))  # by so much ips is off, and this is why
    assert result.effective_decisions == 320.0
    assert result.snips_effective == result.dr_effective == 200.0  # the propensities promised no more
    assert result.ips_effective == pytest.approx(400**2 / (320 * 2.0**2)) == 125.0
    assert result.few == ()
    rare = estimate(np.full(400, 0.5), chosen, propensities, np.tile([1.0, 0.0], (400, 1)))
    assert rare.few == ("ips", "snips", "dr") and rare.ips_effective == rare.snips_effective == 80.0
    never = estimate(np.full(400, 0.5), np.ones(400), propensities, np.tile([1.0, 0.0], (400, 1)))
    assert never.few == ("ips", "snips", "dr") and never.snips is None and never.ips_effective == 0.0


def test_a_rare_choice_that_was_not_made_does_not_make_an_estimate_look_sure():
    """The target would choose the second policy in one of ten decisions, the run in one of ten thousand, and it never did."""
    chosen, propensities = np.zeros(500, np.int64), np.tile([0.9999, 0.0001], (500, 1))
    result = estimate(np.ones(500), chosen, propensities, np.tile([0.9, 0.1], (500, 1)))
    assert result.effective_decisions == pytest.approx(500.0) and result.few == ("ips", "snips", "dr")


def test_wrong_input():
    with pytest.raises(UsageError, match="do not fit"):
        estimate([1.0], [0], [[0.5, 0.5]], [[1.0]])
    with pytest.raises(UsageError, match="finite"):
        estimate([np.nan], [0], [[0.5, 0.5]], [[1.0, 0.0]])
    with pytest.raises(UsageError, match="no propensity"):
        estimate([1.0], [0], [[0.0, 1.0]], [[1.0, 0.0]])


@pytest.mark.parametrize(("rare", "wider"), [(2, 2.0**0.5), (8, 1.0)])
def test_a_rare_choice_that_was_not_made_often_enough_widens_intervals(rare, wider):
    """Of 100 decisions 4 were to be the rare ones: where they are fewer, the sum of squared weights promised is scaled to, else nothing is."""
    chosen = np.arange(100) < rare
    propensities, target = np.tile([0.96, 0.04], (100, 1)), np.tile([0.0, 1.0], (100, 1))
    rewards = np.arange(100) % 2.0
    result = estimate(rewards, chosen, propensities, target)
    plain = 1.959964 * (chosen / 0.04 * rewards).std(ddof=1) / 10.0
    assert (result.ips_ci95[1] - result.ips_ci95[0]) / 2.0 == pytest.approx(wider * plain)
