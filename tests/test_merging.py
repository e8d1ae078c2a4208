"""`merge:a+b`: several policies asked at once, and one chunk made of their answers."""

from dataclasses import replace

import numpy as np
import pytest

import osel_sim as osel
from osel_sim.core.errors import ContentError, OselError, UnknownNameError, UsageError
from osel_sim.episodes.drivers import Drivers, choose_policies, with_fallbacks
from osel_sim.episodes.expected_costs import expected_costs
from osel_sim.episodes.loop import Driver, run_episode
from osel_sim.episodes.merged_caller import AGREEMENT, MergedCaller, merge_chunks
from osel_sim.episodes.most_costs import most_costs
from osel_sim.formats.library import load_policy
from osel_sim.formats.merged_policy import MergedSpec, merged
from osel_sim.formats.policy_file import Price, Remote
from osel_sim.interface.call import Call
from osel_sim.interface.environment import ActionSpec, EnvironmentSpec
from osel_sim.interface.specification import specification
from osel_sim.policy.registry import make_policy
from osel_sim.selection.reward import RewardWeights
from osel_sim.suites.base import BaseEnvironment

ACTION = ActionSpec(("x", "y", "hand"), (-2.0, -1.0, -1.0), (2.0, 1.0, 1.0), gripper="hand")


class Logged(BaseEnvironment):
    """An environment of two motions and a gripper that notes its actions."""

    def __init__(self, horizon: int = 12) -> None:
        super().__init__(EnvironmentSpec("logged", 10, ACTION, {"position": 2}, ("top", "side"), "top"), horizon)

    def start(self, instance):
        self.made = []

    def act(self, action):
        self.made.append(action)
        return False

    def render(self, camera):
        return np.full((64, 64, 3), self.steps, np.uint8)

    def state(self):
        return {"position": np.zeros(2)}


class Answers:
    """A caller with always the same answer, or failing from a call on."""

    def __init__(self, action, seconds=0.0, length=8, fails_at=None):
        self.chunk = np.tile(np.float32(action), (length, 1))
        self.seconds, self.fails_at, self.calls, self.seen = seconds, fails_at, 0, []

    def reset(self, instruction, seed):
        self.calls, self.seed = 0, seed

    def call(self, observation):
        self.calls += 1
        self.seen.append(observation)
        if self.fails_at is not None and self.calls >= self.fails_at:
            return Call(None, upload=1.0, failure="deadline", sent=self.fails_at > 1)
        return Call(self.chunk, inference=self.seconds, megabytes=0.5)

    def close(self):
        pass


@pytest.fixture(scope="module")
def part():
    """A policy file of ours, to be changed."""
    return replace(load_policy("local_small"), cameras=("top",), image_size=64)


def test_a_mean_where_they_agree_and_the_trusted_one_where_they_do_not():
    near, far = np.float32([2 * AGREEMENT, 0.0, -1.0]), np.float32([2 * AGREEMENT + 0.01, 0.0, -1.0])  # half of x's range is 2
    first = np.float32([[0.0, 0.2, 1.0]])
    assert merge_chunks([first, near[None]], ACTION).tolist() == [pytest.approx([AGREEMENT, 0.1, 1.0])]
    assert merge_chunks([first, far[None]], ACTION).tolist() == [pytest.approx([0.0, 0.2, 1.0])]
    assert merge_chunks([far[None], first], ACTION).tolist() == [pytest.approx([2 * AGREEMENT + 0.01, 0.0, -1.0])]


def test_grippers_are_never_averaged_and_chunks_are_as_long_as_the_shorter_one():
    one, other = np.tile(np.float32([0, 0, 1]), (5, 1)), np.tile(np.float32([0, 0.5, -1]), (3, 1))
    result = merge_chunks([one, other], ACTION)
    assert result.shape == (3, 3) and result.dtype == np.float32
    assert result[0].tolist() == [0.0, 0.25, 1.0]


def test_of_three_those_that_agree_with_the_trusted_one_are_averaged():
    chunks = [np.float32([[0.0, value, 0.0]]) for value in (0.0, 0.4, 1.0)]
    assert merge_chunks(chunks, ACTION)[0, 1] == pytest.approx(0.2)


def _merge(part, first, second, **changes):
    specs = {
        "a": replace(part, name="a", price=Price(per_call=1.0, per_action=0.1, per_megabyte=2.0), execute=4),
        "b": replace(part, name="b", price=Price(per_call=0.5, per_action=0.01), execute=6, **changes),
    }
    spec = merged("merge:a+b", lambda name: specs[name])
    return spec, MergedCaller(spec, [Driver(specs["a"], first), Driver(specs["b"], second)], ACTION)


def _drive(env, instance, spec, caller):
    env.load(instance)
    return run_episode(env, instance, Driver(spec, caller))


@pytest.fixture(scope="module")
def instance():
    from osel_sim.suites.registry import find_task

    return find_task("lift").instance(0)


def test_both_are_paid_and_the_slower_is_waited_for(part, instance):
    env, first, second = Logged(), Answers([0.2, 0.0, 1.0]), Answers([0.4, 0.0, -1.0], seconds=0.2)
    spec, caller = _merge(part, first, second, remote=Remote())
    outcome = _drive(env, instance, spec, caller)
    assert (outcome.calls, outcome.actions, outcome.steps) == (2, 8, 12)  # 2 steps of waiting and 4 actions, twice
    assert outcome.seconds.inference == pytest.approx(0.4)
    assert outcome.price == pytest.approx(2 * (1.0 + 0.5 * 2.0 + 0.5) + 8 * 0.11)
    assert [action.tolist() for action in env.made[2:6]] == [pytest.approx([0.3, 0.0, 1.0])] * 4
    assert first.seed[:-1] == second.seed[:-1] and first.seed != second.seed


def test_where_one_fails_the_other_goes_on_alone_and_is_paid_alone(part, instance):
    env, first, second = Logged(20), Answers([0.2, 0.0, 1.0], fails_at=2), Answers([0.4, 0.0, -1.0])
    spec, caller = _merge(part, first, second)
    outcome = _drive(env, instance, spec, caller)
    assert outcome.error is None and outcome.fallback is None
    assert (first.calls, second.calls) == (2, 3)  # once it failed it is not asked again
    assert [round(float(action[0]), 2) for action in env.made] == [0.3] * 4 + [0.0] * 10 + [0.4] * 6  # its deadline of 1 s was waited for
    assert outcome.price == pytest.approx(2 * 1.0 + 0.5 * 2.0 + 3 * 0.5 + 4 * 0.11 + 6 * 0.01)


def test_where_all_fail_the_call_does_and_says_why(part, instance):
    spec, caller = _merge(part, Answers([0] * 3, fails_at=1), Answers([0] * 3, fails_at=1))
    outcome = _drive(Logged(), instance, spec, caller)
    assert outcome.error == "merge:a+b: a: deadline; b: deadline"
    assert (outcome.calls, outcome.price) == (0, 0.0)


def test_the_selector_says_who_is_trusted(part, instance):
    far = (Answers([2.0, 0.0, 1.0]), Answers([-2.0, 0.0, -1.0]))
    spec, caller = _merge(part, *far)
    for propensities, goes in (({}, 2.0), ({"a": 0.2, "b": 0.3}, -2.0), ({"a": 0.3, "b": 0.3}, 2.0), ({"b": 0.1}, -2.0)):
        env = Logged(4)
        caller.trust(propensities)
        _drive(env, instance, spec, caller)
        assert {action[0] for action in env.made} == {goes}


def test_each_sees_what_it_would_see_alone(part, instance):
    class Shown(Logged):
        def observe(self, cameras, size):
            return {**super().observe(cameras, size), "size": size}

    env, first, second = Shown(), Answers([0.0] * 3), Answers([0.0] * 3)
    spec, caller = _merge(part, first, second, cameras=("side",), image_size=32, history=1)
    assert (spec.cameras, spec.image_size, spec.execute) == (("top", "side"), 64, 4)
    _drive(env, instance, spec, caller)
    for seen, camera, size in ((first.seen[0], "top", 64), (second.seen[0], "side", 32)):
        assert {key for key in seen if "images" in key} == {f"observation.images.{camera}"}
        assert seen["size"] == size


def test_one_that_looks_back_does_and_the_other_does_not(part, instance):
    env, first, second = Logged(), Answers([0.0] * 3), Answers([0.0] * 3)
    spec, caller = _merge(part, first, second, history=3)
    _drive(env, instance, spec, caller)
    assert first.seen[1]["observation.images.top"][0, 0, 0] == 4
    assert second.seen[1]["observation.images.top"][:, 0, 0, 0].tolist() == [2, 3, 4]


@pytest.mark.parametrize("name", ["merge:", "merge:local_small", "merge:a+a", "merge:a+", "merge:+a+b", "merge:a+merge:b"])
def test_a_wrong_merge_is_refused(name):
    with pytest.raises(UsageError, match="a merge names two or more different policies"):
        choose_policies([name], specification())


def test_parts_are_found_by_name_and_checked():
    with pytest.raises(UnknownNameError, match="did you mean 'local_small'"):
        choose_policies(["merge:local_smal+remote_large"], specification())
    with pytest.raises(ContentError, match=r"local_small\.toml: observation\.cameras"):
        choose_policies(["merge:local_small+remote_large"], Logged().specification)


def test_a_merge_is_all_that_its_parts_are():
    [spec] = choose_policies(["merge:local_small+remote_large"], specification())
    assert isinstance(spec, MergedSpec) and spec.is_remote and not spec.is_privileged
    assert (spec.cameras, spec.execute, spec.inference_seconds) == (("agentview", "wrist"), 8, 0.077)
    assert spec.remote is not None and spec.remote.fallback == "local_small"
    assert [other.name for other in with_fallbacks([spec])] == [spec.name, "local_small", "remote_large"]
    assert choose_policies(["merge:local_small+scripted_expert"], specification())[0].is_privileged
    large = load_policy("remote_large")
    costs = expected_costs([spec, large], RewardWeights(0.0, 0.01), 100, specification())
    assert costs[spec.name] == pytest.approx(costs["remote_large"])  # the local part is free
    most = most_costs([spec, large], with_fallbacks([spec, large]), 120, specification())
    assert most[spec.name] == pytest.approx(most["remote_large"]) and most[spec.name] > 120 * 0.1125


@pytest.mark.parametrize(
    "use", [load_policy, lambda name: make_policy(choose_policies([name], specification())[0], specification()), osel.load_policy]
)
def test_a_merge_is_not_loaded_or_served(use):
    with pytest.raises(OselError, match=r"in an episode|in a run or a recording"):
        use("merge:local_small+remote_large")


class Straight:
    """A policy object."""

    def __init__(self, speed):
        self.speed = speed

    def reset(self, instruction):
        pass

    def act(self, observation):
        return np.tile(np.float32([self.speed, 0.0, 1.0]), (6, 1))


def test_objects_are_merged_too(instance):
    env = Logged(6)
    objects = {name: osel.as_policy(Straight(speed), name, execute=3, price_per_action=0.5) for name, speed in (("slow", 0.2), ("fast", 0.6))}
    specs = choose_policies(["merge:slow+fast", "slow"], env.specification, objects=objects)
    with Drivers(with_fallbacks(specs), env.specification, objects) as drivers:
        drivers.trust({})
        env.load(instance)
        outcome = run_episode(env, instance, drivers["merge:slow+fast"], drivers.fallback("merge:slow+fast"))
    assert [float(action[0]) for action in env.made] == pytest.approx([0.4] * 6)
    assert (outcome.price, outcome.calls) == (6.0, 2)
