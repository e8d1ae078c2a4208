"""Policies that come and go: what every selector keeps to, by name."""

import numpy as np
import pytest
from test_selection_selectors import DIM, NAMES, SETTINGS, make, play

from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.interface.selector import Changes, Choice
from osel_sim.selection.base import SelectorBase
from osel_sim.selection.registry import make_selector
from osel_sim.selection.state import load_state, save_state

CONTEXT = np.ones(DIM, np.float32)


def learned(name: str, decisions: int = 40):
    """A selector of `local` and `remote` that has seen that `remote` is better."""
    selector = make(name)
    play(selector, decisions)
    return selector


@pytest.mark.parametrize("name", NAMES)
def test_policies_come_and_go(name):
    selector = learned(name)
    assert isinstance(selector, Changes)
    selector.add_policy("new")
    play(selector, 10, seed=1)
    selector.retire_policy("local")
    assert selector.policies == ("remote", "new")
    for choice in play(selector, 30, seed=2):
        assert tuple(choice.propensities) == ("remote", "new")
        assert sum(choice.propensities.values()) == pytest.approx(1.0, abs=1e-9)
    selector.add_policy("local")
    assert selector.policies == ("remote", "new", "local")
    for choice in play(selector, 20, seed=3):
        assert tuple(choice.propensities) == selector.policies
    with pytest.raises(UsageError, match="already"):
        selector.add_policy("local")
    with pytest.raises(UnknownNameError, match="did you mean 'local'"):
        selector.retire_policy("locale")


@pytest.mark.parametrize("name", NAMES)
def test_a_state_holds_what_came_and_went(name, tmp_path):
    def changed(seed: int):
        selector = make(name, seed)
        selector.add_policy("new")
        selector.retire_policy("local")
        return selector

    first, second = changed(0), changed(7)
    play(first, 13)
    save_state(first.state_dict(), tmp_path / "state")
    second.load_state_dict(load_state(tmp_path / "state"))
    assert play(second, 20, seed=1) == play(first, 20, seed=1)


@pytest.mark.parametrize("name", NAMES)
def test_the_last_policy_stays(name):
    selector = make(name)
    selector.retire_policy("local")
    assert selector.select(CONTEXT).propensities == {"remote": 1.0}
    with pytest.raises(UsageError, match="last one"):
        selector.retire_policy("remote")


@pytest.mark.parametrize("name", NAMES)
def test_an_outcome_of_a_policy_that_has_retired_is_no_error(name):
    selector = learned(name, 10)
    selector.add_policy("new")
    choice = selector.select(CONTEXT)
    if choice.policy == "remote":
        return
    selector.retire_policy(choice.policy)
    selector.update(CONTEXT, choice, 0.5)
    assert choice.policy not in selector.select(CONTEXT).propensities


def test_the_policy_of_a_fixed_selector_stays():
    selector = make("fixed:remote")
    with pytest.raises(UsageError, match="fixed:local"):
        selector.retire_policy("remote")


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("fixed:remote", "random")])
def test_what_was_learned_of_the_others_stays(name):
    """The odds between those that stay are what they were, as far as a newcomer leaves any."""
    selector = make_selector(name, ("bad", "good"), DIM, 0, **SETTINGS.get(name, {}))
    generator = np.random.default_rng(0)
    for context in generator.normal(size=(80, DIM)).astype(np.float32):
        choice = selector.select(context)
        selector.update(context, choice, float(choice.policy == "good"))
    before = selector.select(CONTEXT).propensities
    selector.add_policy("new")
    after = selector.select(CONTEXT).propensities
    assert (after["good"] >= after["bad"]) == (before["good"] >= before["bad"])
    selector.retire_policy("new")
    again = selector.select(CONTEXT).propensities
    assert (again["good"] >= again["bad"]) == (before["good"] >= before["bad"])


@pytest.mark.parametrize("name", ["auto", "linucb", "lints", "neural_linear", "thompson", "ucb1", "epsilon_greedy"])
def test_a_policy_that_comes_back_is_remembered(name):
    selector = learned(name)
    counts = selector._counts.copy()
    selector.retire_policy("local")
    selector.add_policy("local")
    assert selector.known == ("local", "remote") and (selector._counts == counts).all()


@pytest.mark.parametrize("offset", [0.0, 10.0, -10.0])
@pytest.mark.parametrize("name", ["auto", "linucb", "linucb_discounted", "thompson_window", "ucb1"])
def test_a_better_newcomer_is_found_whatever_rewards_are(name, offset):
    selector, generator, chosen = make(name), np.random.default_rng(3), []
    for decision in range(200):
        if decision == 60:
            selector.add_policy("newcomer")
        context = generator.normal(size=DIM).astype(np.float32)
        choice = selector.select(context)
        selector.update(context, choice, offset + float(generator.random() < {"local": 0.3, "remote": 0.5, "newcomer": 0.9}[choice.policy]))
        chosen.append(choice.policy)
    assert chosen[150:].count("newcomer") > 25


class Stranger(SelectorBase):
    """A selector of somebody who knows of no columns."""

    name = "stranger"

    def _select(self, context):
        return Choice(self.policies[0], {policy: float(policy == self.policies[0]) for policy in self.policies})

    def _update(self, context, choice, reward):
        return None

    def _state(self):
        return {}

    def _load(self, state):
        return None


def test_a_selector_that_cannot_says_so():
    selector = Stranger(("a", "b"), DIM, 0)
    with pytest.raises(UsageError, match="'stranger' cannot retire policies"):
        selector.retire_policy("a")
