"""UCB1, Thompson sampling, tuned PPO and Vowpal Wabbit's bandits on problems with known answers."""

import sys

import numpy as np
import pytest

from osel_sim.analysis.engine import replay_one
from osel_sim.api.replay import choose_selectors
from osel_sim.core.errors import UsageError
from osel_sim.selection.registry import make_selector, setting_names

POLICIES = ("a", "b", "c")


def clustered(decisions: int, seed: int):
    """Two kinds of instances; the third policy is never good, each of the others on one kind."""
    generator = np.random.default_rng(seed)
    kind = generator.integers(2, size=decisions)
    contexts = (np.eye(2)[kind] @ generator.normal(size=(2, 20)) + 0.1 * generator.normal(size=(decisions, 20))).astype(np.float32)
    rates = np.array([[0.9, 0.2, 0.1], [0.2, 0.8, 0.1]])[kind]
    return contexts, (generator.random((decisions, 3)) < rates).astype(float), rates


@pytest.mark.parametrize("name", ["ucb1", "thompson"])
def test_without_context_the_best_single_policy_is_found(name):
    generator = np.random.default_rng(0)
    rewards = (generator.random((3000, 3)) < [0.3, 0.6, 0.5]).astype(float)
    chosen = replay_one(name, np.zeros((3000, 2), np.float32), rewards, POLICIES, 1)
    assert np.mean(chosen[2000:] == 1) > (0.6 if name == "ucb1" else 0.85)
    assert len(set(chosen[:3].tolist())) == 3 or name != "ucb1"


def test_ucb1_is_its_formula():
    selector = make_selector("ucb1", ("a", "b"), 1, 0, width=2.0)
    context = np.zeros(1, np.float32)
    rewards, counts, sums = {"a": 0.5, "b": 0.4}, {"a": 0, "b": 0}, {"a": 0.0, "b": 0.0}
    for decision in range(60):
        choice = selector.select(context)
        if decision >= 2:
            index = {name: sums[name] / counts[name] + 2.0 * np.sqrt(2 * np.log(decision) / counts[name]) for name in counts}
            assert choice.policy == max(index, key=index.get)
        counts[choice.policy] += 1
        sums[choice.policy] += rewards[choice.policy]
        selector.update(context, choice, rewards[choice.policy])


@pytest.mark.parametrize("name", ["vw_squarecb", "vw_regcb", "ppo_tuned"])
def test_with_context_the_best_policy_of_each_kind_is_found(name):
    if name.startswith("vw_"):
        pytest.importorskip("vowpalwabbit")
    decisions = 1500
    contexts, rewards, rates = clustered(decisions, 0)
    chosen = replay_one(name, contexts, rewards, POLICIES, 0)
    late = np.arange(decisions * 3 // 4, decisions)
    best_single, oracle = rates[late].mean(axis=0).max(), rates[late].max(axis=1).mean()
    assert (rates[late, chosen[late]].mean() - best_single) / (oracle - best_single) > 0.6


def test_without_the_package_vowpal_wabbit_is_refused_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "vowpalwabbit", None)
    with pytest.raises(UsageError, match=r"osel-sim\[vw\]"):
        make_selector("vw_squarecb", POLICIES, 3, 0)
    monkeypatch.setattr("osel_sim.selection.vowpal.available", lambda: False)
    with pytest.raises(UsageError, match=r"'vw_regcb' needs.*osel-sim\[vw\]"):
        choose_selectors(["ppo", "vw_regcb"])
    everything = choose_selectors(None)
    assert not [name for name in everything if name.startswith("vw_")] and {"ppo", "auto", "thompson"} <= set(everything)
    assert "fixed" not in everything and "kernel_ucb" not in everything  # that is what auto is


@pytest.mark.parametrize(
    ("name", "setting", "value"),
    [
        ("ucb1", "width", 0.0),
        ("vw_squarecb", "gamma_scale", -1.0),
        ("vw_squarecb", "learning_rate", 0.0),
        ("vw_regcb", "mellowness", 0.0),
        ("vw_regcb", "lowest", 1.0),
        ("ppo_tuned", "components", 0),
        ("ppo_tuned", "n_steps", 1),
    ],
)
def test_settings_out_of_range(name, setting, value):
    assert setting in setting_names(name)
    with pytest.raises(UsageError):
        make_selector(name, POLICIES, 3, 0, **{setting: value})
