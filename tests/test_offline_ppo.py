"""PPO's quick replay against SB3's own code: the same choices and, to rounding, the same weights."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from osel_sim.analysis.engine import replay_one
from osel_sim.selection.ppo import kernel
from osel_sim.selection.ppo.compiled import FastPPO, supports
from osel_sim.selection.registry import make_selector

POLICIES = ("a", "b", "c")


def problem(decisions: int, dim: int, seed: int = 0):
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(4, dim)) / np.sqrt(dim)
    cluster = generator.integers(4, size=decisions)
    contexts = (centres[cluster] + 0.2 / np.sqrt(dim) * generator.normal(size=(decisions, dim))).astype(np.float32)
    return contexts, (generator.random((decisions, len(POLICIES))) < generator.random((4, 3))[cluster]) - 0.1 * generator.random((decisions, 3))


def decision_by_decision(selector, contexts, rewards):
    chosen = []
    for context, row in zip(contexts, rewards, strict=True):
        choice = selector.select(context)
        chosen.append(selector.policies.index(choice.policy))
        selector.update(context, choice, float(row[chosen[-1]]))
    return np.array(chosen)


def weights(tower) -> np.ndarray:
    return np.concatenate([part.ravel() for part in tower])


def sb3_weights(selector, hidden: str, output: str) -> np.ndarray:
    state = selector.algorithm.policy.state_dict()
    names = [key for key in state if key.startswith(f"mlp_extractor.{hidden}.")] + [f"{output}.weight", f"{output}.bias"]
    return np.concatenate([state[name].numpy().ravel() for name in names])


CASES = {
    "paper": ("ppo", 64, 40, {}),
    "paper, no limit on the divergence": ("ppo", 16, 60, {"target_kl": None, "layers": (32, 16)}),
    "unclipped gradients": ("ppo", 16, 60, {"max_grad_norm": 1e9, "layers": (32,), "ent_coef": 0.2}),
    "rollouts that are no multiple of five": ("ppo", 16, 100, {"n_steps": 13, "batch_size": 13, "layers": (32, 16), "learning_rate": 3e-3}),
    "GELU, as in the code of the paper's authors": ("ppo", 16, 60, {"activation": "gelu", "layers": (64, 32)}),
    "tuned": ("ppo_tuned", 48, 200, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_same_as_sb3(case):
    name, dim, decisions, settings = CASES[case]
    contexts, rewards = problem(decisions, dim)
    selector = make_selector(name, POLICIES, dim, 7, **settings)
    expected = decision_by_decision(selector, contexts, rewards)
    fresh = make_selector(name, POLICIES, dim, 7, **settings)
    assert supports(fresh)
    quick = FastPPO(fresh)
    chosen = quick.run(fresh.network_inputs(contexts), rewards)
    assert (chosen == expected).all() and len(set(expected.tolist())) == 3
    for tower, hidden, output in ((quick.actor, "policy_net", "action_net"), (quick.critic, "value_net", "value_net")):
        theirs = sb3_weights(selector, hidden, output)
        assert np.abs(theirs - tower[0]).max() < 2e-5
        moved = np.abs(theirs - sb3_weights(make_selector(name, POLICIES, dim, 7, **settings), hidden, output)).max()
        assert moved > 2e-3  # a hundred times what may differ
    assert torch.equal(fresh.random_streams.torch, selector.random_streams.torch)  # as many draws were made


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_what_is_not_covered_goes_through_sb3():
    contexts, rewards = problem(20, 8)
    settings = {"batch_size": 2, "layers": (8,)}
    assert not supports(make_selector("ppo", POLICIES, 8, 3, **settings))
    expected = decision_by_decision(make_selector("ppo", POLICIES, 8, 3, **settings), contexts, rewards)
    assert (replay_one("ppo", contexts, rewards, POLICIES, 3, **settings) == expected).all()


@pytest.mark.slow
def test_compiled_afresh_or_from_the_cache_it_is_the_same_to_the_bit(tmp_path):
    code = (
        "import hashlib, test_offline_ppo as tests\n"
        "contexts, rewards = tests.problem(200, 64)\n"
        "quick = tests.FastPPO(tests.make_selector('ppo', tests.POLICIES, 64, 7))\n"
        "quick.run(contexts, rewards)\n"
        "print(hashlib.sha256(tests.weights([*quick.actor[:1], *quick.critic[:1]]).tobytes()).hexdigest())"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    here = Path(__file__).parent
    first, second = (
        subprocess.run([sys.executable, "-c", code], cwd=here, env=environment, capture_output=True, text=True, check=True) for _ in range(2)
    )
    assert list(tmp_path.rglob("*train*.nbc"))
    assert first.stdout == second.stdout


def test_it_learns():
    contexts, rewards = problem(3000, 16, seed=4)
    chosen = replay_one("ppo_tuned", contexts, rewards, POLICIES, 0)
    assert len(kernel.train.signatures) == len(kernel.forward.signatures) == 1  # what `prepare` compiles is what is used
    late = rewards[np.arange(2000, 3000), chosen[2000:]].mean()
    assert late > rewards[2000:].mean(axis=0).max() + 0.1
