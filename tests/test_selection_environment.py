"""The selection problem as an environment: checkers pass, and any SB3 algorithm runs on it."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from osel_sim.core.errors import UsageError
from osel_sim.selection.environment import SelectionEnv, table_rounds

POLICIES = ("local", "remote")


def table(instances: int = 50, dim: int = 5):
    """The sign of a context's first number says which policy gets the reward."""
    contexts = np.random.default_rng(0).normal(size=(instances, dim)).astype(np.float32)
    return contexts, np.stack([contexts[:, 0] > 0, contexts[:, 0] <= 0], axis=1).astype(float)


def environment() -> SelectionEnv:
    return SelectionEnv(table_rounds(*table()), POLICIES, 5)


# Contexts have no bounds of their own, which gymnasium wonders about; nothing else may be warned of.
@pytest.mark.filterwarnings("error", "ignore:.*infinity")
def test_checkers():
    check_env(environment(), skip_render_check=True)
    check_env_sb3(environment())


@pytest.mark.parametrize("action", [2, -1, 1.0, True, np.True_, "local", None, [1], np.array([1])])
def test_an_action_that_is_no_policy_is_refused(action):
    env = environment()
    env.reset(seed=0)
    with pytest.raises(UsageError, match=r"an action must be the index of a policy, an integer in \[0, 1\], got"):
        env.step(action)
    assert env.step(np.array(1))[4] == {"policy": "remote"}
    with pytest.raises(UsageError, match="unknown option of reset 'level'"):
        env.reset(options={"level": 1})


def test_one_decision_an_episode():
    contexts, rewards = table()
    env = SelectionEnv(table_rounds(contexts, rewards, in_order=True), POLICIES, 5)
    for row in (0, 1, 2):
        observation, _ = env.reset()
        assert np.array_equal(observation, contexts[row])
        _, reward, terminated, truncated, info = env.step(np.int64(1))
        assert (reward, terminated, truncated, info) == (rewards[row, 1], True, False, {"policy": "remote"})
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.int64(0))


def test_only_the_chosen_policy_runs():
    ran = []

    def draw(generator):
        return np.zeros(5, np.float32), lambda action: ran.append(action) or 0.5

    env = SelectionEnv(draw, POLICIES, 5)
    env.reset()
    assert env.step(np.int64(1))[1] == 0.5
    assert ran == [1]


@pytest.mark.parametrize("algorithm", [A2C, DQN])
def test_other_algorithms_learn_on_it(algorithm):
    settings = (
        {"n_steps": 16} if algorithm is A2C else {"learning_starts": 50, "exploration_fraction": 0.5, "train_freq": 1, "target_update_interval": 50}
    )
    model = algorithm("MlpPolicy", environment(), gamma=0.0, learning_rate=3e-3, seed=0, device="cpu", **settings)
    model.learn(800)
    contexts, rewards = table()
    actions, _ = model.predict(contexts, deterministic=True)
    assert rewards[np.arange(len(rewards)), actions].mean() > 0.8


def test_tables_that_do_not_fit():
    with pytest.raises(UsageError, match=r"\(3, 2\), \(4, 2\)"):
        table_rounds(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(UsageError):
        table_rounds(np.zeros((0, 2)), np.zeros((0, 2)))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_tables_without_every_number_are_refused(number):
    contexts, rewards = table()
    rewards[[3, 4], 1] = number
    with pytest.raises(UsageError, match=rf"rewards\[3, 1\] is {number} \(2 of 50 rows have such\)"):
        table_rounds(contexts, rewards)
    contexts[0, 2] = number
    with pytest.raises(UsageError, match=r"contexts\[0, 2\]"):
        table_rounds(contexts, rewards)
