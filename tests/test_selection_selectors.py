"""What every selector keeps to, by name, and the simple ones' own behaviour."""

import subprocess
import sys

import numpy as np
import pytest

from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.interface.selector import Choice
from osel_sim.selection.epsilon_greedy import EpsilonGreedySelector
from osel_sim.selection.registry import BUILT_IN, make_selector, selector_locations
from osel_sim.selection.state import load_state, save_state

POLICIES = ("local", "remote")
NAMES = ["fixed:remote" if name == "fixed" else name for name in sorted(BUILT_IN)]
SETTINGS = {"ppo": {"layers": (16,)}, "ppo_tuned": {"n_steps": 8}, "epsilon_greedy": {"gap": 0.1}}
DIM = 6

pytestmark = pytest.mark.filterwarnings("error::UserWarning")


def make(name: str, seed: int = 0):
    return make_selector(name, POLICIES, DIM, seed, **SETTINGS.get(name, {}))


def play(selector, decisions: int, seed: int = 0):
    generator = np.random.default_rng(seed)
    choices = []
    for context in generator.normal(size=(decisions, DIM)).astype(np.float32):
        context.flags.writeable = False  # as of a cache: it is only ever read
        choices.append(selector.select(context))
        selector.update(context, choices[-1], float(choices[-1].policy == "remote") + generator.normal())
    return choices


@pytest.mark.parametrize("name", NAMES)
def test_same_seed_same_choices(name):
    assert play(make(name), 30) == play(make(name), 30)


@pytest.mark.parametrize("name", NAMES)
def test_propensities_cover_every_policy_and_match_frequencies(name):
    selector = make(name)
    for choice in play(selector, 30):
        assert tuple(choice.propensities) == POLICIES
        assert sum(choice.propensities.values()) == pytest.approx(1.0, abs=1e-9)
        assert choice.propensities[choice.policy] > 0
    choices = [selector.select(np.ones(DIM, np.float32)) for _ in range(1000)]
    for policy in POLICIES:
        expected = np.mean([choice.propensities[policy] for choice in choices])
        assert np.mean([choice.policy == policy for choice in choices]) == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize("name", NAMES)
def test_save_load_continue(name, tmp_path):
    whole = make(name)
    expected = play(whole, 13) + play(whole, 20, seed=1)
    first = make(name)
    play(first, 13)
    save_state(first.state_dict(), tmp_path / "state")
    second = make(name, seed=8)
    second.load_state_dict(load_state(tmp_path / "state"))
    assert play(second, 20, seed=1) == expected[13:]


@pytest.mark.parametrize("name", NAMES)
def test_add_policy(name):
    selector = make(name)
    play(selector, 13)
    selector.add_policy("new")
    assert selector.policies == ("local", "remote", "new")
    for choice in play(selector, 13):
        assert tuple(choice.propensities) == selector.policies
    with pytest.raises(UsageError, match="already"):
        selector.add_policy("local")


@pytest.mark.parametrize("name", NAMES)
def test_wrong_input(name):
    selector = make(name)
    good = np.zeros(DIM, np.float32)
    choice = selector.select(good)
    for bad in (np.zeros(DIM + 1, np.float32), np.zeros(DIM), np.full(DIM, np.nan, np.float32), [0.0] * DIM):
        with pytest.raises(UsageError, match="context"):
            selector.select(bad)
    with pytest.raises(UsageError, match="finite"):
        selector.update(good, choice, float("nan"))
    with pytest.raises(DataError, match="selector"):
        selector.load_state_dict({"selector": "another"})


@pytest.mark.parametrize(("policies", "dim", "seed"), [((), 4, 0), (("a", "a"), 4, 0), (("a",), 0, 0), (("a",), 4, -1), (("a",), 4, 2**32)])
def test_wrong_construction(policies, dim, seed):
    with pytest.raises(UsageError):
        make_selector("random", policies, dim, seed)


def test_unknown_names_get_a_suggestion():
    with pytest.raises(UnknownNameError, match="did you mean 'epsilon_greedy'"):
        make("epsilon_gready")
    with pytest.raises(UnknownNameError, match="did you mean 'remote'"):
        make("fixed:remot")
    with pytest.raises(UnknownNameError, match="selector 'ppo:remote'"):
        make("ppo:remote")
    with pytest.raises(UsageError, match="fixed:local"):
        make("fixed")
    with pytest.raises(UnknownNameError, match="did you mean 'gap'"):
        make_selector("epsilon_greedy", POLICIES, DIM, 0, gab=0.1)


def test_listing_imports_nothing_heavy():
    code = "import sys, osel_sim.selection.registry as r; r.selector_locations(); print({'torch', 'gymnasium'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


def test_a_plugin_package_offers_a_selector(tmp_path, monkeypatch):
    (tmp_path / "their_package.py").write_text(
        "from osel_sim.selection.uniform import UniformSelector\nclass Theirs(UniformSelector):\n    name = 'theirs'\n"
    )
    info = tmp_path / "their_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[osel_sim.selectors]\ntheirs = their_package:Theirs\nppo = their_package:Theirs\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert selector_locations()["theirs"] == "their_package:Theirs"
    assert selector_locations()["ppo"] == BUILT_IN["ppo"]
    assert type(make("theirs")).__name__ == "Theirs"


def test_epsilon_of_the_paper():
    selector = EpsilonGreedySelector(POLICIES, DIM, seed=0)
    context = np.zeros(DIM, np.float32)
    epsilons = []
    for _ in range(400):
        epsilons.append(selector.epsilon)
        selector.update(context, selector.select(context), 0.0)
    assert epsilons[:200] == [1.0] * 200
    assert epsilons[399] == pytest.approx(2 / (400 * 0.01))


def test_epsilon_greedy_finds_the_better_policy_and_ignores_context():
    selector = EpsilonGreedySelector(POLICIES, DIM, seed=0, gap=0.5)
    play(selector, 300)
    late = play(selector, 100, seed=1)
    assert np.mean([choice.policy == "remote" for choice in late]) > 0.95
    assert late[-1].propensities["remote"] == pytest.approx(1 - selector.epsilon / 2, rel=1e-2)
    with pytest.raises(UsageError, match="gap"):
        EpsilonGreedySelector(POLICIES, DIM, seed=0, gap=0.0)


def test_a_choice_must_be_a_distribution():
    with pytest.raises(UsageError, match="sum to 1"):
        Choice("a", {"a": 0.5, "b": 0.4})
    with pytest.raises(UsageError, match="sum to 1"):
        Choice("a", {"a": 1.5, "b": -0.5})
    with pytest.raises(UnknownNameError):
        Choice("c", {"a": 0.5, "b": 0.5})
