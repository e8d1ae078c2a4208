"""Robots that share: what their selectors exchange adds up to what one that sees everything knows."""

import numpy as np
import pytest

from osel_sim.core.errors import UsageError
from osel_sim.selection.fleet import Fleet, InTurn, Sharing
from osel_sim.selection.registry import BUILT_IN, can_share, check_can_share, make_selector

POLICIES = ("a", "b", "c")
ROBOTS, ROUNDS, WIDTH = 3, 24, 6
ADDING_UP = ("auto", "epsilon_greedy", "lints", "linucb", "neural_linear", "thompson", "ucb1")


def _stream(seed: int = 0):
    """Contexts (rounds, robots, width) and rewards (rounds, robots, policies) that depend on them."""
    chance = np.random.default_rng(seed)
    contexts = chance.normal(size=(ROUNDS, ROBOTS, WIDTH)).astype(np.float32)
    rewards = 0.3 * np.stack([contexts[..., 0], -contexts[..., 0], 0.2 + 0 * contexts[..., 0]], axis=-1) + 0.1 * chance.normal(
        size=(ROUNDS, ROBOTS, 3)
    )
    return contexts, rewards


def _unbegun(name: str, share: str, delay: int = 0, **settings: object) -> Fleet:
    return Fleet(lambda robot: make_selector(name, POLICIES, WIDTH, 7 + robot, **settings), ROBOTS, Sharing.parse(share, delay))


def _fleet(name: str, share: str, delay: int = 0) -> Fleet:
    fleet = _unbegun(name, share, delay)
    fleet.begin()
    return fleet


@pytest.mark.parametrize("name", ADDING_UP)
def test_robots_that_share_at_once_believe_what_one_that_sees_everything_would(name: str) -> None:
    contexts, rewards = _stream()
    shared, central = _fleet(name, "every:1"), _fleet(name, "all")
    for step in range(ROUNDS):
        for robot in range(ROBOTS):
            own, whole = shared.select(robot, contexts[step, robot]), central.select(robot, contexts[step, robot])
            assert own.propensities == pytest.approx(whole.propensities, abs=1e-9)
            reward = float(rewards[step, robot, POLICIES.index(whole.policy)])  # what one of them drew: they draw by themselves
            for fleet in (shared, central):
                fleet.update(robot, contexts[step, robot], whole, reward)
        shared.end_round()
        central.end_round()


def test_linucb_makes_the_very_same_choices_as_one_that_sees_everything() -> None:
    contexts, rewards = _stream(1)
    chosen = {}
    for share in ("every:1", "all", "none"):
        stream = InTurn(_unbegun("linucb", share, expected_costs={"a": 0.0, "b": 0.01, "c": 0.02}))  # without, it draws from equals at first
        chosen[share] = []
        for step in range(ROUNDS):
            for robot in range(ROBOTS):
                choice = stream.select(contexts[step, robot])
                chosen[share].append((choice.policy, choice.propensities))
                stream.update(contexts[step, robot], choice, float(rewards[step, robot, POLICIES.index(choice.policy)]))
    assert chosen["every:1"] == chosen["all"]
    assert chosen["none"] != chosen["all"]


@pytest.mark.parametrize("name", ["ppo", "ppo_tuned"])
def test_ppo_averages_its_weights(name: str) -> None:
    make = {"ppo": {"layers": (8,)}, "ppo_tuned": {"layers": (8,), "n_steps": 4}}[name]
    fleet = Fleet(lambda robot: make_selector(name, POLICIES, WIDTH, 7 + robot, **make), ROBOTS, Sharing.parse("every:20"))
    fleet.begin()
    begun = [selector.share() for selector in fleet.selectors]
    assert all(np.array_equal(begun[0][key], other[key]) for other in begun for key in begun[0])
    contexts, rewards = _stream(2)
    for step in range(20):
        for robot in range(ROBOTS):
            choice = fleet.select(robot, contexts[step, robot])
            fleet.update(robot, contexts[step, robot], choice, float(rewards[step, robot, POLICIES.index(choice.policy)]))
        if step == 19:
            for robot, decided in fleet._decided.items():
                fleet.selectors[robot].update(*decided)
            fleet._decided.clear()
            alone = [selector.share() for selector in fleet.selectors]
        fleet.end_round()
    after = [selector.share() for selector in fleet.selectors]
    key = "action_net.weight"
    assert not np.array_equal(alone[0][key], alone[1][key])
    for own in after:
        np.testing.assert_allclose(own[key], np.mean([message[key] for message in alone], axis=0), atol=1e-6)
    if name == "ppo_tuned":  # weights mean the same only where contexts look the same
        assert all(np.array_equal(own["scale.turn"], after[0]["scale.turn"]) for own in after)


def test_what_is_under_way_is_not_known_before_it_arrives() -> None:
    fleet = _fleet("ucb1", "every:2", delay=3)
    contexts, _ = _stream()
    seen = []
    for step in range(8):
        for robot in range(ROBOTS):
            fleet.update(robot, contexts[step, robot], fleet.select(robot, contexts[step, robot]), 1.0)
        fleet.end_round()
        seen.append(int(fleet.selectors[0].state_dict()["counts"].sum()))
    # Its own decisions, and those that the two others made before rounds 2 and 4, which arrive in rounds 5 and 7.
    assert seen == [1, 2, 3, 4, 5 + 2 * 2, 6 + 2 * 2, 7 + 2 * 4, 8 + 2 * 4]


def test_unequal_streams_end_when_they_end() -> None:
    fleet, contexts = _fleet("thompson", "every:1"), _stream()[0]
    for step in range(6):
        for robot in range(ROBOTS if step < 3 else 1):
            fleet.update(robot, contexts[step, robot], fleet.select(robot, contexts[step, robot]), 0.5)
        fleet.end_round()
    assert [int(selector.state_dict()["counts"].sum()) for selector in fleet.selectors] == [3 * 3 + 3] * 3


@pytest.mark.parametrize("name", [*ADDING_UP, "ppo_tuned"])
def test_a_state_goes_on_sharing_where_it_was(name: str) -> None:
    contexts, rewards = _stream(3)
    first, second = (make_selector(name, POLICIES, WIDTH, 5) for _ in range(2))
    first.begin(None)
    for step in range(ROUNDS):
        choice = first.select(contexts[step, 0])
        first.update(contexts[step, 0], choice, float(rewards[step, 0, 0]))
    second.load_state_dict(first.state_dict())
    one, other = first.share(), second.share()
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[key], other[key]) for key in one)
    first.absorb([one, one], 0)
    second.absorb([other, other], 0)
    assert first.select(contexts[0, 0]).propensities == second.select(contexts[0, 0]).propensities


def test_a_selector_alone_keeps_the_state_that_it_always_had() -> None:
    for name in ADDING_UP:
        assert not any(key.startswith("fresh") for key in make_selector(name, POLICIES, WIDTH, 0).state_dict())


def test_selectors_that_cannot_share_are_refused_by_name_with_those_that_can() -> None:
    for name in ("random", "fixed:a"):
        with pytest.raises(UsageError, match=f"'{name}' has nothing.*auto, epsilon_greedy, kernel_ucb, lints, linucb, neural_linear, ppo, ppo_tuned"):
            check_can_share(["auto", name])
    assert {name for name in BUILT_IN if not name.startswith("vw_") and can_share(name)} == {*ADDING_UP, "kernel_ucb", "ppo", "ppo_tuned"}


@pytest.mark.parametrize("text", ["", "every", "every:", "every:0", "every:-1", "every:1.5", "every:²", "sometimes", "All", "every:20:3", "every: 5"])
def test_a_wrong_way_to_share_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--share must be none, all, or every:N"):
        Sharing.parse(text)


def test_a_delay_without_an_exchange_is_refused() -> None:
    for text in ("none", "all"):
        with pytest.raises(UsageError, match="--share-delay 2 is for --share every:N"):
            Sharing.parse(text, 2)
