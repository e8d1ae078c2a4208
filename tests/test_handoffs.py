"""Handoffs within an episode, on the real simulator: who drives, what waits, what it costs, and what would have come of them."""

from dataclasses import replace

import numpy as np
import pytest
from test_episode import HORIZON, PRICE, LoggedEnv, Numbered, made, spec

from osel_sim.core import content
from osel_sim.core.errors import UnknownNameError, UsageError
from osel_sim.episodes.handoff_episodes import handoff_episodes
from osel_sim.episodes.handoffs import Handoffs
from osel_sim.episodes.loop import Driver, Subscriber, run_episode
from osel_sim.episodes.moment import go_on
from osel_sim.formats.task_file import load_task_file
from osel_sim.interface.monitor import Turn
from osel_sim.selection.monitors.environment import HandoffEnv
from osel_sim.selection.reward import RewardWeights, reward, to_go
from osel_sim.sim.instance import make_instance


class Fleet(dict):
    def fallback(self, name):
        return None


class Told:
    """Hands over as it is told: call -> policy. Asks first whom it is told to ask."""

    def __init__(self, turns=(), asks=()):
        self.turns, self.asks, self.points, self.answers = dict(turns), dict(asks), [], []

    def reset(self, instruction, driver, seed):
        self.points = []

    def drives_on(self, point):
        self.points.append(point)
        if point.call in self.asks:
            self.answers.append(point.look.difference(self.asks[point.call]))
        return Turn(self.turns.get(point.call, point.driver), "told to")

    def learn(self, watched):
        pass


class Points(Subscriber):
    def __init__(self):
        self.points, self.turns, self.drove = [], [], []

    def on_step(self, frame):
        self.drove.append(frame.policy)

    def on_point(self, point, turn):
        self.points.append(point)
        self.turns.append(turn)


@pytest.fixture(scope="module")
def env():
    env = LoggedEnv(replace(load_task_file(content.find("tasks", "pick_place")), horizon=HORIZON))
    yield env
    env.close()


@pytest.fixture
def instance(env):
    instance = make_instance(env.task, 3)
    env.load(instance)
    return instance


def fleet(**callers):
    """One policy for each caller; `small` runs on the robot, all others are remote."""
    return Fleet({name: Driver(spec(name, mode=None if name == "small" else name.partition("_")[0]), caller) for name, caller in callers.items()})


def handoffs(drivers, monitor, every=1, **settings):
    return Handoffs(drivers, tuple(drivers), monitor, every, HORIZON, **settings)


def test_new_policy_waits_on_its_network_and_the_old_chunk_is_dropped(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(inference=0.2))
    monitor, seen = Told({1: "blocking"}), Points()
    outcome = run_episode(env, instance, drivers["small"], subscribers=[seen], handoffs=handoffs(drivers, monitor))
    assert made(env)[:12] == [(1, index) for index in range(8)] + ["-"] * 4
    told = outcome.monitored
    assert [(one.step, one.call, one.driver, one.to, one.why) for one in told.handoffs] == [(8, 1, "small", "blocking", "told to")]
    assert told.by_policy["small"].steps == 8 and told.by_policy["blocking"].steps == outcome.steps - 8
    assert told.duty_steps == (outcome.steps - 8) / outcome.steps and told.duty_calls == (outcome.calls - 1) / outcome.calls
    assert sum(one.price for one in told.by_policy.values()) == pytest.approx(outcome.price)
    assert told.by_policy["small"].price == pytest.approx(PRICE.of(8, 1, 0.5))
    assert [point.call for point in seen.points] == [1, 2] and told.points == 2
    assert seen.drove == ["small"] * 8 + ["blocking"] * (outcome.steps - 8)  # what videos write into the frame


def test_async_policy_finishes_the_chunk_of_the_one_before(env, instance):
    drivers = fleet(small=Numbered(), **{"async": Numbered(inference=0.2)})
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told({1: "async"})))
    assert made(env)[:16] == [(1, index) for index in range(12)] + [(1, index) for index in range(4, 8)]
    assert outcome.monitored.by_policy["small"].actions == 12  # whose chunk it was is paid for it
    assert outcome.monitored.by_policy["small"].steps == 8  # but does not drive any more


def test_a_monitor_that_never_hands_over_changes_nothing(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(inference=0.2))
    with_monitor = run_episode(env, instance, drivers["blocking"], handoffs=handoffs(drivers, Told(), 2), action_noise=0.1)
    env.load(instance)
    without = run_episode(env, instance, drivers["blocking"], action_noise=0.1)
    assert replace(with_monitor, monitored=None) == without and with_monitor.monitored.handoffs == ()
    assert "monitored" not in without.to_dict()


def test_signals_are_of_what_can_be_seen(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered())
    seen = Points()

    class Looks(Told):
        def drives_on(self, point):
            point.look.change()
            return super().drives_on(point)

    run_episode(env, instance, drivers["small"], subscribers=[seen], handoffs=handoffs(drivers, Looks(), 1))
    first, second, third = seen.points
    assert (first.step, second.step) == (8, 16) and first.time_used == 8 / HORIZON and first.driver == "small"
    # The last two chunks both planned four moments: indices 8 to 11 of the one, 0 to 3 of the next, call numbers one apart; six motions.
    assert first.overlap is None and second.overlap == pytest.approx(np.sqrt((0.08**2 + 0.01**2) / 6), rel=1e-4)
    assert first.moved > 0 and first.look.change() is None and 0 < second.look.change() < 1
    assert third.price == pytest.approx(3 * PRICE.of(8, 1, 0.5))


def test_asking_a_second_policy_is_paid_and_its_answer_used(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(inference=0.2))
    monitor = Told({1: "blocking"}, asks={1: "blocking"})
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, monitor, 4))
    assert outcome.monitored.handoffs == ()  # at every fourth call only
    env.load(instance)
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, monitor, 1))
    assert monitor.answers == [pytest.approx(0.08 / np.sqrt(6), rel=1e-4)]  # the same call number, indices 8 to 11 against 0 to 3
    assert made(env)[:20] == [(1, index) for index in range(8)] + ["-"] * 4 + [(1, index) for index in range(8)]
    assert drivers["blocking"].caller.calls == outcome.monitored.by_policy["blocking"].calls
    env.load(instance)
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told({}, asks={1: "blocking"}), 1))
    asked = outcome.monitored.by_policy["blocking"]
    assert (asked.steps, asked.calls, asked.actions) == (0, 1, 0) and asked.price == pytest.approx(PRICE.of(0, 1, 0.5))
    assert outcome.price == pytest.approx(asked.price + outcome.monitored.by_policy["small"].price)


def test_going_on_from_a_moment_is_what_handing_over_there_would_have_been(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(inference=0.2))
    moments = {}

    def cut(point, keep):
        moments[point.call] = keep()

    whole = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told(), cut=cut), action_noise=0.1)
    assert whole.monitored.handoffs == () and sorted(moments) == [1, 2, 3]
    told = {call: go_on(moment, "blocking") for call, moment in reversed(moments.items())}
    for call, outcome in told.items():
        env.load(instance)
        live = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told({call: "blocking"})), action_noise=0.1)
        assert replace(outcome, monitored=None) == replace(live, monitored=None)
        assert outcome.monitored.by_policy == live.monitored.by_policy
        assert outcome.monitored.handoffs == tuple(replace(one, why="") for one in live.monitored.handoffs)
    with pytest.raises(UsageError, match="another policy than 'small'"):
        go_on(moments[1], "small")


class ChunkedEnv(LoggedEnv):
    """Takes several actions at once, as an environment in another process does."""

    def advance_chunk(self, actions):
        self.chunks = getattr(self, "chunks", 0) + 1
        for number, action in enumerate(actions):
            if self.done:
                return number
            self.advance(action)
        return len(actions)


def test_environments_that_take_chunks_come_to_the_same(env, instance):
    chunked, outcomes = ChunkedEnv(env.task), []
    for world, name in ((env, "blocking"), (chunked, "blocking"), (env, "async"), (chunked, "async")):
        drivers = fleet(small=Numbered(), **{name: Numbered(inference=0.2)})
        world.load(instance)
        outcomes.append(run_episode(world, instance, drivers["small"], handoffs=handoffs(drivers, Told({1: name}, asks={1: name, 2: "small"}))))
    assert chunked.chunks > 4 and outcomes[0] == outcomes[1] and outcomes[2] == outcomes[3]
    chunked.close()


def test_real_episodes_as_a_sequential_problem(env, instance):
    """As `HandoffEnv` is made of them: the rewards sum to the reward-to-go from the first decision point."""
    drivers = fleet(small=Numbered(), blocking=Numbered(inference=0.2))
    weights = RewardWeights(0.2, 0.01)
    begin = handoff_episodes(env, [instance], handoffs(drivers, Told()), weights, lambda point: np.array([point.step], np.float32))
    problem, seen = HandoffEnv(begin, tuple(drivers), 1), Points()
    row, _ = problem.reset(seed=0)
    total, over, steps = 0.0, False, [int(row[0])]
    while not over:
        row, reward_then, over, _, _ = problem.step(1)
        steps.append(int(row[0]))
        total += reward_then
    first = "small" if steps[0] == 8 else "blocking"
    env.load(instance)
    turns = {call: "blocking" for call in range(1, 9)}
    outcome = run_episode(env, instance, drivers[first], subscribers=[seen], handoffs=handoffs(drivers, Told(turns)))
    point = seen.points[0]
    assert steps[:-1] == [point.step for point in seen.points]
    assert total == pytest.approx(to_go(reward(outcome, weights), [point.seconds], [point.step], [point.price], weights)[0])


def test_what_a_monitor_gets_wrong_is_told(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered())
    with pytest.raises(UnknownNameError, match="did you mean 'blocking'"):
        run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told({1: "blockin"})))
    with pytest.raises(UsageError, match="at least 1, got 0"):
        handoffs(drivers, Told(), 0)

    class Broken(Told):
        def drives_on(self, point):
            raise ZeroDivisionError("a bug of the monitor")

    env.load(instance)
    with pytest.raises(ZeroDivisionError):  # not a policy's failure
        run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Broken()))


def test_a_policy_that_fails_while_it_is_asked_is_an_error_and_one_without_an_answer_is_not(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(raise_at=1))
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told(asks={1: "blocking"})))
    assert "ZeroDivisionError" in outcome.error
    drivers, monitor = fleet(small=Numbered(), blocking=Numbered(fail_at=1)), Told(asks={1: "blocking"})
    env.load(instance)
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, monitor))
    assert outcome.error is None and monitor.answers == [None]


def test_fallback_is_that_of_who_drives(env, instance):
    drivers = fleet(small=Numbered(), blocking=Numbered(fail_at=1))
    drivers.fallback = lambda name: drivers["small"] if name == "blocking" else None
    outcome = run_episode(env, instance, drivers["small"], handoffs=handoffs(drivers, Told({1: "blocking"})))
    assert outcome.fallback == "deadline" and outcome.fallback_steps == outcome.steps - 8 - 5
    assert outcome.monitored.by_policy["small"].steps == outcome.steps - 5 and outcome.monitored.by_policy["blocking"].steps == 5
