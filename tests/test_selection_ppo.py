"""PPO behind the selector protocol: the same bits as stable-baselines3, undisturbed, resumable, and it learns."""

import random
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from osel_sim.analysis.engine import replay_one
from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.interface.selector import Choice
from osel_sim.selection.environment import SelectionEnv, table_rounds
from osel_sim.selection.ppo.sb3 import PPOSelector
from osel_sim.selection.state import load_state, save_state

POLICIES = ("a", "b", "c")
SMALL = {"layers": (32, 16)}


def problem(seed: int, instances: int, dim: int = 32):
    """Four clusters of contexts, on each of which one policy succeeds in 9 of 10, the others in 2 of 10. -> contexts, rewards, success rates."""
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(4, dim))
    rates = np.full((4, len(POLICIES)), 0.2)
    rates[np.arange(4), [0, 1, 2, 0]] = 0.9
    cluster = generator.integers(4, size=instances)
    contexts = (centres[cluster] + 0.1 * generator.normal(size=(instances, dim))).astype(np.float32)
    return contexts, (generator.random((instances, len(POLICIES))) < rates[cluster]).astype(float), rates[cluster]


def play(selector, contexts, rewards):
    """Run the protocol over rows; -> columns chosen."""
    chosen = []
    for context, row in zip(contexts, rewards, strict=True):
        choice = selector.select(context)
        chosen.append(selector.policies.index(choice.policy))
        selector.update(context, choice, row[chosen[-1]])
    return np.array(chosen)


def decided(seed, contexts, rewards):
    """Decision by decision, as a live run does it."""
    return play(PPOSelector(POLICIES, 32, seed), contexts, rewards)


def replayed(seed, contexts, rewards):
    """All at once, as a replay does it: the same choices (`test_offline_ppo.py`), many times faster."""
    return replay_one("ppo", contexts, rewards, POLICIES, seed)


def weights(selector) -> list[torch.Tensor]:
    return [value.clone() for value in selector.algorithm.policy.state_dict().values()]


def same(first: list[torch.Tensor], second: list[torch.Tensor]) -> bool:
    return len(first) == len(second) and all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


def sb3(contexts, rewards, decisions: int, batch_size: int, layers) -> PPO:
    """The paper's settings, written out, in SB3's own loop."""
    env = SelectionEnv(table_rounds(contexts, rewards, in_order=True), POLICIES, contexts.shape[1])
    algorithm = PPO(
        "MlpPolicy",
        env,
        gamma=0.0,
        n_steps=5,
        batch_size=batch_size,
        learning_rate=1e-4,
        target_kl=0.003,
        ent_coef=0.01,
        policy_kwargs={"net_arch": list(layers)},
        seed=7,
        device="cpu",
    )
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return algorithm.learn(decisions)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("batch_size", [5, 64], ids=["batch of 5", "SB3's default batch"])
def test_same_weights_as_learn(batch_size):
    contexts, rewards, _ = problem(0, 30)
    reference = sb3(contexts, rewards, 30, batch_size, (768, 512, 128, 64, 16))
    selector = PPOSelector(POLICIES, 32, seed=7)
    untrained = weights(selector)
    play(selector, contexts, rewards)
    assert same(weights(selector), list(reference.policy.state_dict().values()))
    assert not same(weights(selector), untrained)
    assert selector.algorithm.num_timesteps == reference.num_timesteps == 30
    assert selector.algorithm._n_updates == reference._n_updates


def test_nobody_disturbs_it_and_it_disturbs_nobody():
    contexts, rewards, _ = problem(1, 20)
    quiet = PPOSelector(POLICIES, 32, seed=3, **SMALL)
    play(quiet, contexts, rewards)

    torch.manual_seed(11), np.random.seed(12), random.seed(13)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate(), torch.get_num_threads()
    disturbed = PPOSelector(POLICIES, 32, seed=3, **SMALL)
    play(disturbed, contexts[:7], rewards[:7])
    assert torch.equal(before[0], torch.get_rng_state())
    assert (before[1], before[2], before[3]) == (np.random.get_state()[1].tolist(), random.getstate(), torch.get_num_threads())
    for context, row in zip(contexts[7:], rewards[7:], strict=True):
        torch.rand(3), np.random.random(3)
        play(disturbed, [context], [row])
    assert same(weights(quiet), weights(disturbed))


def test_bits_do_not_depend_on_the_number_of_threads():
    contexts, rewards, _ = problem(1, 20, dim=1024)
    results, threads = [], torch.get_num_threads()
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            selector = PPOSelector(POLICIES, 1024, seed=3)
            play(selector, contexts, rewards)
            results.append(weights(selector))
    finally:
        torch.set_num_threads(threads)
    assert same(*results)


@pytest.mark.parametrize("stop", [0, 3, 10, 23], ids=lambda stop: f"after {stop}")
def test_save_load_continue_is_bit_identical(stop, tmp_path: Path):
    contexts, rewards, _ = problem(2, 40)
    whole = PPOSelector(POLICIES, 32, seed=5, **SMALL)
    chosen = play(whole, contexts, rewards)

    first = PPOSelector(POLICIES, 32, seed=5, **SMALL)
    play(first, contexts[:stop], rewards[:stop])
    save_state(first.state_dict(), tmp_path / "selector.safetensors")
    play(first, contexts[stop:], rewards[stop:])  # what is saved must not change with the selector

    second = PPOSelector(POLICIES, 32, seed=99, **SMALL)
    second.load_state_dict(load_state(tmp_path / "selector.safetensors"))
    assert play(second, contexts[stop:], rewards[stop:]).tolist() == chosen[stop:].tolist()
    assert same(weights(whole), weights(second))
    ended, resumed = whole.state_dict(), second.state_dict()
    assert ended.keys() == resumed.keys()
    assert all(np.array_equal(ended[key], resumed[key]) for key in ended)


def test_propensities_sum_to_one_and_match_frequencies():
    contexts, rewards, _ = problem(3, 30)
    selector = PPOSelector(POLICIES, 32, seed=0, learning_rate=1e-2, target_kl=None, **SMALL)
    play(selector, contexts, rewards)
    choices = [selector.select(contexts[0]) for _ in range(1500)]
    propensities = choices[0].propensities
    assert sum(propensities.values()) == pytest.approx(1.0, abs=1e-12)
    assert max(propensities.values()) > 0.4, "training should have moved them away from a third each"
    for policy, propensity in propensities.items():
        assert np.mean([choice.policy == policy for choice in choices]) == pytest.approx(propensity, abs=0.03)
    chosen = choices[0]
    assert chosen.details["log_probability"] == pytest.approx(np.log(propensities[chosen.policy]), abs=1e-5)


@pytest.mark.parametrize(
    ("seed", "how"), [(0, replayed), pytest.param(1, decided, marks=pytest.mark.slow), pytest.param(2, decided, marks=pytest.mark.slow)]
)
def test_beats_the_best_fixed_policy_where_context_helps(seed, how):
    contexts, rewards, rates = problem(seed, 900)
    chosen = how(seed, contexts, rewards)
    expected = rates[np.arange(len(rates)), chosen]
    best_fixed = rates.mean(axis=0).max()
    assert expected[-225:].mean() > best_fixed + 0.07
    assert expected[-225:].mean() > expected[:225].mean() + 0.1


def test_several_choices_in_flight():
    contexts, rewards, _ = problem(4, 40)
    selector = PPOSelector(POLICIES, 32, seed=0, **SMALL)
    waiting = []
    for index, context in enumerate(contexts):
        waiting.append((index, selector.select(context)))
        if len(waiting) == 4:
            done, choice = waiting.pop(0)
            selector.update(contexts[done], choice, rewards[done, POLICIES.index(choice.policy)])
    assert selector.algorithm.num_timesteps == 37
    assert all(torch.isfinite(value).all() for value in weights(selector))


def test_add_policy_keeps_what_was_learned_of_the_others():
    contexts, rewards, _ = problem(5, 60)
    selector = PPOSelector(POLICIES, 32, seed=0, learning_rate=1e-2, target_kl=None, **SMALL)
    play(selector, contexts, rewards)
    before = selector.select(contexts[0]).propensities
    in_flight = selector.select(contexts[1])
    selector.add_policy("d")
    after = selector.select(contexts[0]).propensities
    assert selector.policies == (*POLICIES, "d")
    assert sum(after.values()) == pytest.approx(1.0)
    assert after["a"] / after["b"] == pytest.approx(before["a"] / before["b"], rel=1e-4)
    assert min(before.values()) * 0.5 < after["d"] < 0.3
    selector.update(contexts[1], in_flight, 1.0)  # of the old layer: dropped, not an error
    assert selector.algorithm.rollout_buffer.pos == 0

    always_d = np.tile([0.0, 0.0, 0.0, 1.0], (400, 1))
    play(selector, np.resize(contexts, (400, 32)), always_d)
    assert selector.select(contexts[0]).propensities["d"] > 0.8
    fresh = PPOSelector((*POLICIES, "d"), 32, seed=1, learning_rate=1e-2, target_kl=None, **SMALL)
    fresh.load_state_dict(selector.state_dict())
    assert fresh.select(contexts[0]) == selector.select(contexts[0])


def test_a_choice_of_another_selector_is_refused():
    selector = PPOSelector(POLICIES, 32, seed=0, **SMALL)
    context = np.zeros(32, np.float32)
    with pytest.raises(UsageError, match="its own choices"):
        selector.update(context, Choice("a", {"a": 0.5, "b": 0.25, "c": 0.25}), 1.0)
    with pytest.raises(UnknownNameError):
        selector.update(context, Choice("z", {"z": 1.0}), 1.0)


@pytest.mark.parametrize("settings", [{"n_steps": 1}, {"batch_size": 1}, {"n_epochs": 0}, {"learning_rate": 0.0}, {"layers": (8, 0)}])
def test_settings_out_of_range(settings):
    with pytest.raises(UsageError, match=next(iter(settings))):
        PPOSelector(POLICIES, 32, seed=0, **settings)


def test_state_of_other_settings_or_damaged_is_refused():
    state = PPOSelector(POLICIES, 8, seed=0, **SMALL).state_dict()
    with pytest.raises(DataError, match="settings"):
        PPOSelector(POLICIES, 8, seed=0, layers=(16,)).load_state_dict(state)
    with pytest.raises(DataError, match="policies"):
        PPOSelector(("a", "b"), 8, seed=0, **SMALL).load_state_dict(state)
    with pytest.raises(DataError, match="incomplete or damaged"):
        PPOSelector(POLICIES, 8, seed=0, **SMALL).load_state_dict({k: v for k, v in state.items() if k != "network.value_net.bias"})
