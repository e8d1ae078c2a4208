"""LinUCB, linear Thompson sampling, neural-linear and `auto`: they learn what can be learned, and nothing breaks them."""

import math
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest

from osel_sim.core.errors import DataError, UnknownNameError, UsageError
from osel_sim.episodes.expected_costs import expected_costs
from osel_sim.formats.policy_file import PolicySpec, Price, Remote
from osel_sim.interface.selector import Choice
from osel_sim.interface.specification import specification
from osel_sim.selection.change_point import change_point
from osel_sim.selection.features import Components, Landmarks, Sketch
from osel_sim.selection.kernel_ucb import KernelUCBSelector
from osel_sim.selection.registry import make_selector
from osel_sim.selection.reward import RewardWeights
from osel_sim.selection.state import load_state, save_state

POLICIES = ("a", "b", "c")
CONTEXTUAL = ("linucb", "lints", "neural_linear", "auto")


def clusters(seed: int, decisions: int, dim: int = 40, informative: bool = True):
    """Six clusters, in each of which one policy succeeds in 9 of 10 and the others in 2 of 10. -> contexts, rewards, success rates."""
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(6, dim))
    rates = np.full((6, 3), 0.2)
    rates[np.arange(6), np.arange(6) % 3] = 0.9
    if not informative:
        rates[:] = (0.2, 0.7, 0.4)
    cluster = generator.integers(6, size=decisions)
    contexts = (centres[cluster] + 0.3 * generator.normal(size=(decisions, dim))).astype(np.float32)
    return contexts, (generator.random((decisions, 3)) < rates[cluster]).astype(float), rates[cluster]


def play(selector, contexts, rewards):
    """Run the protocol over rows; -> columns chosen."""
    chosen = []
    for context, row in zip(contexts, rewards, strict=True):
        choice = selector.select(context)
        chosen.append(selector.policies.index(choice.policy))
        selector.update(context, choice, row[chosen[-1]])
    return np.array(chosen)


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_learns_which_policy_is_good_where(name):
    contexts, rewards, rates = clusters(0, 800)
    chosen = play(make_selector(name, POLICIES, 40, seed=0), contexts, rewards)
    received = rates[np.arange(800), chosen]
    assert rates.mean(axis=0).max() < 0.5  # what a single policy can get
    assert received[-200:].mean() > 0.8


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_where_context_does_not_help_it_finds_the_best_single_policy(name):
    contexts, rewards, _ = clusters(1, 800, informative=False)
    selector = make_selector(name, POLICIES, 40, seed=0)
    chosen = play(selector, contexts, rewards)
    if name == "neural_linear":  # its network finds features in the noise, and the evidence of the same decisions believes them
        assert (chosen[-400:] == 1).mean() > 0.8
    else:
        assert (chosen[-400:] == 1).mean() > 0.9
        assert selector.signal < 0.05


def test_a_region_that_no_line_cuts_off():
    """Good inside a ball, bad outside: linear features see nothing of it, landmarks do."""
    generator = np.random.default_rng(0)
    contexts = generator.normal(size=(1200, 2)).astype(np.float32)
    inside = (contexts**2).sum(axis=1) < 1.4
    rewards = np.stack([inside, ~inside], axis=1).astype(float)
    late = {}
    for name in ("linucb", "auto"):
        chosen = play(make_selector(name, ("in", "out"), 2, seed=0), contexts, rewards)
        late[name] = rewards[np.arange(1200), chosen][-300:].mean()
    assert late["auto"] > 0.9
    assert late["linucb"] < 0.7


def test_declared_costs_are_charged():
    """Two policies equally good: with costs declared the dearer one is tried less from the start."""
    generator = np.random.default_rng(0)
    contexts = generator.normal(size=(200, 8)).astype(np.float32)
    rewards = (generator.random((200, 1)) < 0.6) - np.array([[0.0, 0.3]])
    declared = make_selector("auto", ("free", "dear"), 8, seed=0, expected_costs={"free": 0.0, "dear": 0.3, "later": 0.1})
    unknown = make_selector("auto", ("free", "dear"), 8, seed=0)
    assert (play(declared, contexts, rewards) == 1).sum() <= (play(unknown, contexts, rewards) == 1).sum() <= 60
    declared.add_policy("later")
    with pytest.raises(UnknownNameError, match="did you mean 'later'"):
        declared.add_policy("latter")
    with pytest.raises(UnknownNameError, match="dear"):
        make_selector("auto", ("free", "dear"), 8, seed=0, expected_costs={"free": 0.0})


def test_contexts_without_outcomes_can_come_first():
    contexts, rewards, rates = clusters(2, 300)
    warm = make_selector("auto", POLICIES, 40, seed=0, warm_contexts=contexts)
    state = warm.state_dict()
    assert state["features.landmarks"].shape[0] >= 6
    received = rates[np.arange(300), play(warm, contexts, rewards)]
    assert received[-100:].mean() > 0.75
    with pytest.raises(DataError, match="settings"):  # other contexts, other features
        make_selector("auto", POLICIES, 40, seed=0).load_state_dict(state)
    with pytest.raises(UsageError, match="warm_contexts"):
        make_selector("auto", POLICIES, 41, seed=0, warm_contexts=contexts)


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_state_round_trip_is_bit_identical(name, tmp_path):
    contexts, rewards, _ = clusters(3, 80, dim=300)  # longer than the sketch
    whole, chosen = make_selector(name, POLICIES, 300, seed=5), np.zeros(80, np.int64)
    stops = (0, 1, 40)
    for start, end in pairwise((*stops, 80)):
        save_state(whole.state_dict(), tmp_path / str(start))
        chosen[start:end] = play(whole, contexts[start:end], rewards[start:end])
    ended = whole.state_dict()
    for stop in stops:
        other = make_selector(name, POLICIES, 300, seed=6)
        other.load_state_dict(load_state(tmp_path / str(stop)))
        assert play(other, contexts[stop:], rewards[stop:]).tolist() == chosen[stop:].tolist()
        resumed = other.state_dict()
        assert ended.keys() == resumed.keys()
        assert all(np.array_equal(ended[key], resumed[key]) for key in ended)


@pytest.mark.parametrize("name", ["auto", "neural_linear"])
def test_outcomes_learned_together_leave_what_they_leave_one_by_one(name):
    contexts, rewards, _ = clusters(8, 70)
    together, one_by_one = (make_selector(name, POLICIES, 40, seed=0) for _ in range(2))
    for number, (context, row) in enumerate(zip(contexts, rewards, strict=True)):
        choice = Choice(POLICIES[number % 3], dict.fromkeys(POLICIES, 1 / 3))
        for selector in (together, one_by_one):
            selector.update(context, choice, row[number % 3])
        assert one_by_one.signal > 0.0  # asked, it has to have learned
    ends = [selector.state_dict() for selector in (together, one_by_one)]
    assert all(np.array_equal(ends[0][key], ends[1][key]) for key in ends[1])
    context = contexts[0].copy()
    choice = together.select(context)
    context[:] = contexts[1]  # a buffer that is used again: what was selected on is not what is learned from
    together.update(context, choice, 1.0)
    assert (together.state_dict()["contexts"][-1] == contexts[1]).all()


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_seeds_differ(name):
    contexts, rewards, _ = clusters(4, 60)
    runs = (play(make_selector(name, POLICIES, 40, seed=seed), contexts, rewards).tolist() for seed in range(4))
    first = next(runs)
    assert any(other != first for other in runs)


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_a_policy_added_late_is_tried_and_taken(name):
    contexts, rewards, _ = clusters(5, 400, informative=False)
    selector = make_selector(name, POLICIES[:2], 40, seed=0)
    play(selector, contexts[:100], rewards[:100])
    before = selector.state_dict()["regression.means"]
    selector.add_policy("c")
    assert selector.state_dict()["regression.means"][:2, 0] == pytest.approx(before[:, 0], abs=0.2)
    rewards[:, 2] = 1.0
    assert (play(selector, contexts[100:], rewards[100:])[-100:] == 2).mean() > 0.9


@pytest.mark.parametrize("name", CONTEXTUAL)
@pytest.mark.parametrize("scale", [0.0, 1e-20, 1e-3, 1e6])
def test_constant_and_tiny_and_huge_contexts(name, scale):
    generator = np.random.default_rng(0)
    contexts = (7.0 * (scale != 1e6) + scale * generator.normal(size=(60, 6))).astype(np.float32)
    rewards = np.tile([0.0, 1.0, 0.0], (60, 1))
    chosen = play(make_selector(name, POLICIES, 6, seed=0), contexts, rewards)
    assert (chosen[-20:] == 1).mean() > 0.7


@pytest.mark.parametrize("name", CONTEXTUAL)
@pytest.mark.parametrize("rewards", [np.zeros((40, 3)), np.full((40, 3), -1e4), 1e6 * np.random.default_rng(0).normal(size=(40, 3))])
def test_rewards_of_no_variance_or_another_scale(name, rewards):
    contexts = np.random.default_rng(1).normal(size=(40, 6)).astype(np.float32)
    selector = make_selector(name, POLICIES, 6, seed=0)
    play(selector, contexts, rewards)
    assert np.isfinite(list(selector.select(contexts[0]).propensities.values())).all()
    assert all(np.isfinite(value).all() for value in selector.state_dict().values() if isinstance(value, np.ndarray) and value.dtype.kind == "f")


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_one_policy_and_one_dimension(name):
    contexts = np.random.default_rng(0).normal(size=(30, 1)).astype(np.float32)
    selector = make_selector(name, ("only",), 1, seed=0)
    assert (play(selector, contexts, np.ones((30, 1))) == 0).all()
    assert selector.select(contexts[0]).propensities == {"only": 1.0}


@pytest.mark.parametrize("name", CONTEXTUAL)
def test_updates_may_lag_behind(name):
    contexts, rewards, _ = clusters(6, 60)
    selector = make_selector(name, POLICIES, 40, seed=0)
    for start in range(0, 60, 4):
        choices = [selector.select(context) for context in contexts[start : start + 4]]
        for row, choice in enumerate(choices, start):
            selector.update(contexts[row], choice, rewards[row, POLICIES.index(choice.policy)])
    assert len(selector.state_dict()["chosen"]) == 60


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("auto", {"components": 0}),
        ("auto", {"width": 0.0}),
        ("auto", {"optimism": -1.0}),
        ("auto", {"alarm": 1.0}),
        ("auto", {"chance": float("nan")}),
        ("auto", {"signals": ()}),
        ("linucb", {"signals": (0.0,)}),
        ("lints", {"components": 0}),
        ("neural_linear", {"hidden": 0}),
        ("auto", {"expected_costs": {"a": 0.0, "b": float("inf"), "c": 0.0}}),
    ],
)
def test_wrong_settings(name, settings):
    with pytest.raises(UsageError):
        make_selector(name, POLICIES, 4, 0, **settings)


def test_the_alias_is_the_same_selector():
    assert type(make_selector("auto", POLICIES, 4, 0)) is type(make_selector("kernel_ucb", POLICIES, 4, 0)) is KernelUCBSelector


def test_features_keep_what_matters():
    generator = np.random.default_rng(0)
    contexts = generator.normal(size=(400, 10)) * np.array([5.0, 2.0, 1.0] + [1e-9] * 7)
    whitened = Components(8, 1.0)
    whitened.fit(contexts)
    assert whitened.dim == 3
    assert np.cov(whitened.transform(contexts).T) == pytest.approx(np.eye(3) / 3, abs=0.01)
    centres = 3.0 * generator.normal(size=(5, 10))
    tight = centres[generator.integers(5, size=200)] + 1e-3 * generator.normal(size=(200, 10))
    landmarks = Landmarks(8, 0.0, 0.5, 64)
    landmarks.fit(tight)
    assert landmarks.dim == 5  # one for each cluster
    lengths = (landmarks.transform(tight) ** 2).sum(axis=1)
    assert lengths == pytest.approx(np.ones(200), abs=0.03)
    sketch = Sketch(1024)
    long = generator.normal(size=(2, 1024)).astype(np.float32)
    assert np.linalg.norm(sketch(long[0]) - sketch(long[1])) == pytest.approx(np.linalg.norm(long[0] - long[1]), rel=0.2)


def spec(name: str, execute: int = 8, remote=None, **price):
    return PolicySpec(
        name=name,
        title=name,
        kind="lerobot",
        cameras=("agentview",),
        image_size=96,
        execute=execute,
        inference_seconds=0.02,
        remote=remote,
        price=Price(**price),
        file=Path(f"{name}.toml"),
    )


def test_costs_declared_by_policy_files():
    weights = RewardWeights(0.2, 0.01)
    specs = [
        spec("local"),
        spec("paid", per_action=0.1, per_call=1.0),
        spec("far", remote=Remote("satellite")),
        spec("near", remote=Remote("ethernet")),
        spec("meanwhile", execute=40, remote=Remote("satellite", "async")),
    ]
    costs = expected_costs(specs, weights, actions=80, environment=specification())
    assert costs["local"] == pytest.approx(0.2 * np.log10(4.0))
    assert costs["paid"] - costs["local"] == pytest.approx(0.01 * (80 * 0.1 + 10 * 1.0))
    assert costs["far"] > costs["near"] > costs["local"]
    assert costs["meanwhile"] == pytest.approx(costs["local"], abs=0.01)
    in_steps = expected_costs(specs, RewardWeights(0.05, 0.0, "steps"), actions=80, environment=specification())
    assert in_steps["local"] == pytest.approx(4.0)
    with pytest.raises(UsageError, match="actions"):
        expected_costs(specs, weights, actions=0, environment=specification())


@pytest.mark.parametrize("name", ["auto", "lints"])
def test_bad_luck_at_the_beginning_is_overcome(name):
    """A useless context, and the better policy fails the first three times that it is tried: no seed stays with the worse one."""
    for seed in range(4):
        generator = np.random.default_rng(seed)
        contexts = generator.normal(size=(800, 4)).astype(np.float32)
        rewards = (generator.random((800, 2)) < (0.64, 0.86)).astype(float)
        selector, chosen = make_selector(name, ("worse", "better"), 4, seed), []
        for context, row in zip(contexts, rewards, strict=True):
            choice = selector.select(context)
            chosen.append(choice.policy)
            unlucky = choice.policy == "better" and chosen.count("better") <= 3
            selector.update(context, choice, 0.0 if unlucky else row[int(choice.policy == "better")])
        assert chosen[-200:].count("worse") < 100


@pytest.mark.parametrize("name", ["auto", "linucb_discounted"])
@pytest.mark.parametrize(("scale", "shift"), [(0.01, 0.0), (30.0, 0.0), (1.0, 10.0), (0.1, -5.0)])
def test_scale_and_offset_of_rewards_change_no_choice(name, scale, shift):
    contexts, rewards, _ = clusters(7, 300)
    plain = play(make_selector(name, POLICIES, 40, seed=0), contexts, rewards)
    assert play(make_selector(name, POLICIES, 40, seed=0), contexts, scale * rewards + shift).tolist() == plain.tolist()


def test_hard_contexts_are_not_held_against_the_usual_policy():
    """Some kinds of contexts are hard for both policies, and one is better everywhere: without a part in common the worse one is tried wherever it is
    hard."""
    worse = {(0.0, 0.5): 0, (0.0,): 0}
    for shared, seed in product(worse, range(6)):
        generator = np.random.default_rng(seed)
        centres, rates = generator.normal(size=(20, 16)), 0.9 * generator.random((20, 1)) + np.array([0.0, 0.1])
        kind = generator.integers(20, size=800)
        contexts = (centres[kind] + 0.2 * generator.normal(size=(800, 16))).astype(np.float32)
        rewards = (generator.random((800, 2)) < rates[kind]).astype(float)
        selector = make_selector("auto", ("worse", "better"), 16, seed + 100, shared=shared)
        worse[shared] += (play(selector, contexts, rewards) == 0).sum()
    assert worse[0.0, 0.5] < 0.8 * worse[(0.0,)]


def test_every_policy_keeps_a_chance():
    contexts, rewards, _ = clusters(8, 100, informative=False)
    selector = make_selector("auto", POLICIES, 40, seed=0)
    play(selector, contexts, rewards)
    assert min(selector.select(contexts[0]).propensities.values()) >= 0.1 / np.sqrt(101) / 3


@pytest.mark.parametrize(("decisive", "view"), [("first", 0), ("both", 1), ("second", 2)])
def test_evidence_says_which_part_of_a_context_is_used(decisive, view):
    generator = np.random.default_rng(0)
    first, second = np.eye(4, 24)[generator.integers(4, size=400)], np.eye(4, 16)[generator.integers(4, size=400)]
    contexts = np.concatenate([first + 0.05 * generator.normal(size=first.shape), second], axis=1).astype(np.float32)
    kinds = {"first": first.argmax(axis=1) % 2, "second": second.argmax(axis=1) % 2}
    kinds["both"] = (kinds["first"] + kinds["second"]) % 2
    rewards = (generator.random((400, 2)) < np.array([[0.9, 0.2], [0.2, 0.9]])[kinds[decisive]]).astype(float)
    selector = make_selector("auto", ("a", "b"), 40, seed=0, parts=(24, 16))
    play(selector, contexts, rewards)
    assert selector.state_dict()["view"] == view
    again = make_selector("auto", ("a", "b"), 40, seed=1, parts=(24, 16))
    again.load_state_dict(selector.state_dict())
    assert again.state_dict()["view"] == view
    assert again.select(contexts[0]) == selector.select(contexts[0])
    assert "view" not in make_selector("auto", ("a", "b"), 40, seed=0).state_dict()


@pytest.mark.parametrize("parts", [(24,), (24, 15), (40, 0), (20, 10, 10)])
def test_parts_that_are_none(parts):
    with pytest.raises(UsageError, match="parts"):
        make_selector("auto", ("a", "b"), 40, seed=0, parts=parts)


def worsening():
    """Contexts that say nothing, and rewards of three policies, of which the first is the best for 400 decisions and then the worst."""
    generator = np.random.default_rng(0)
    contexts = generator.normal(size=(700, 8)).astype(np.float32)
    rates = np.where(np.arange(700)[:, None] < 400, [0.8, 0.5, 0.4], [0.2, 0.5, 0.4])
    return contexts, (generator.random(rates.shape) < rates).astype(float)


def test_a_change_is_noticed_between_two_fits():
    contexts, rewards = worsening()
    selector = make_selector("auto", POLICIES, 8, seed=0)
    play(selector, contexts[:440], rewards[:440])  # fits come after 363 and 454 decisions
    assert len(selector.state_dict()["targets"]) < 80


def test_a_change_that_nobody_announced_is_noticed_and_what_was_before_forgotten():
    contexts, rewards = worsening()
    late = {}
    for alarm in (1e4, math.inf):
        selector = make_selector("auto", POLICIES, 8, seed=0, alarm=alarm)
        late[alarm] = (play(selector, contexts, 30.0 * rewards + 5.0)[-150:] == 0).mean()
        assert (len(selector.state_dict()["targets"]) < 400) == math.isfinite(alarm)
    assert late[1e4] < 0.1 and late[math.inf] > 0.3


def test_the_first_failures_of_a_policy_that_hardly_fails_are_no_change():
    chosen, left = np.repeat([0, 1], 80), np.repeat([0.01, 0.0], 80)
    left[78:80] = -7.0
    in_turn = np.arange(160).reshape(2, 80).T.ravel()
    assert change_point(left[in_turn], chosen[in_turn], 2, noise=0.5, alarm=1e3) == 0


def test_many_failures_are_a_change_and_it_is_found_where_it_was():
    generator = np.random.default_rng(0)
    left = np.concatenate([generator.normal(size=200), generator.normal(-1.5, size=40)])
    assert 180 <= change_point(left, np.zeros(240, np.int64), 1, noise=1.0, alarm=1e3) <= 210


def test_where_nothing_changes_nothing_is_forgotten():
    for seed in range(4):
        contexts, rewards, _ = clusters(seed, 300)  # what is chosen changes while it is learned, and with it what each policy earns
        noises = (np.random.default_rng(seed).random((300, 3)) < (0.99, 0.9, 0.5)).astype(float)  # the first hardly varies
        for table in (rewards, noises):
            selector = make_selector("auto", POLICIES, 40, seed=seed)
            play(selector, contexts, table)
            assert len(selector.state_dict()["targets"]) == 300
