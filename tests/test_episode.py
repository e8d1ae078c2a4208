"""The episode loop on the real simulator: waiting, chunks, fallbacks, errors, and listeners that change nothing."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from osel_sim.core import content
from osel_sim.episodes.loop import Driver, Frame, Subscriber, delay_steps, episode_seed, run_episode
from osel_sim.episodes.subscribers import RealTime
from osel_sim.episodes.video import Video
from osel_sim.formats.policy_file import PolicySpec, Price, Remote
from osel_sim.formats.task_file import load_task_file
from osel_sim.interface.call import Call
from osel_sim.sim.env import TaskEnv
from osel_sim.sim.expert import Expert
from osel_sim.sim.instance import make_instance

HORIZON = 32
PRICE = Price(0.02, 0.1, 1.0)


class LoggedEnv(TaskEnv):
    """Notes which actions were made."""

    def load(self, instance):
        super().load(instance)
        self.made = []

    def advance(self, action):
        self.made.append(np.asarray(action).copy())
        super().advance(action)


class Numbered:
    """Chunks whose action i of call c is (c, i) / 100 in the last two rotations, so that what was made can be read off."""

    def __init__(self, length=12, fail_at=None, raise_at=None, reached=True, **seconds):
        self.length, self.fail_at, self.raise_at, self.reached, self.seconds = length, fail_at, raise_at, reached, seconds
        self.resets = []

    def reset(self, instruction, seed):
        self.resets.append((instruction, seed))
        self.calls = 0

    def call(self, observation):
        self.calls += 1
        if self.calls == self.raise_at:
            raise ZeroDivisionError("the policy has\na bug")
        if self.calls == self.fail_at:
            return Call(None, upload=0.25, failure="deadline", sent=self.reached)
        chunk = np.zeros((self.length, 7), np.float32)
        chunk[:, 4], chunk[:, 5], chunk[:, 6] = self.calls / 100, np.arange(self.length) / 100, -1
        return Call(chunk, **{"megabytes": 0.5, **self.seconds})

    def close(self):
        pass


class ExpertCaller:
    """The scripted expert, asked for one action at a time."""

    def __init__(self, env):
        self.expert = Expert(env.world)

    def reset(self, instruction, seed):
        self.expert.reset()

    def call(self, observation):
        return Call(self.expert.act()[None])

    def close(self):
        pass


class Steps(Subscriber):
    def __init__(self):
        self.frames: list[Frame] = []
        self.outcome = None

    def on_step(self, frame):
        self.frames.append(frame)

    def on_end(self, outcome):
        self.outcome = outcome


def spec(name="p", mode=None, execute=8, price=PRICE):
    remote = None if mode is None else Remote(mode=mode)
    return PolicySpec(
        name=name,
        title=name,
        kind="test",
        cameras=("agentview",),
        image_size=32,
        execute=execute,
        inference_seconds=0.01,
        remote=remote,
        price=price,
        file=Path("p.toml"),
    )


@pytest.fixture(scope="module")
def task():
    return load_task_file(content.find("tasks", "pick_place"))


@pytest.fixture(scope="module")
def env(task):
    env = LoggedEnv(replace(task, horizon=HORIZON))
    yield env
    env.close()


@pytest.fixture
def instance(env):
    instance = make_instance(env.task, 3)
    env.load(instance)
    return instance


def made(env):
    """(call, index) of each action made; '-' where the robot held still."""
    pairs = [(round(float(action[4]) * 100), round(float(action[5]) * 100)) for action in env.made]
    return ["-" if call == 0 else (call, index) for call, index in pairs]


def test_blocking_holds_still_for_the_delay_then_executes(env, instance):
    steps = Steps()
    outcome = run_episode(env, instance, Driver(spec(mode="blocking"), Numbered(upload=0.05, inference=0.1, download=0.04)), subscribers=[steps])
    round_trip = ["-"] * 4
    expected = [item for call in (1, 2, 3) for item in [*round_trip, *((call, index) for index in range(8))]][:HORIZON]
    assert made(env) == expected
    assert [frame.waiting for frame in steps.frames] == [item == "-" for item in expected]
    assert (outcome.calls, outcome.actions, outcome.steps) == (3, HORIZON - 12, HORIZON)
    assert outcome.price == pytest.approx(0.02 * 20 + 0.1 * 3 + 1.0 * 1.5)
    assert outcome.seconds.upload == pytest.approx(0.15)
    assert outcome.seconds.inference == pytest.approx(0.3)
    assert outcome.seconds.motion == HORIZON / 20
    assert steps.outcome is outcome
    assert steps.frames[-1].price == outcome.price


def test_async_finishes_the_chunk_and_skips_what_it_made_meanwhile(env, instance):
    run_episode(env, instance, Driver(spec(mode="async"), Numbered(inference=0.2)))
    expected = ["-"] * 4 + [(1, index) for index in range(12)]  # the last four of them while call 2 is answered
    for call in (2, 3):
        expected += [(call, index) for index in range(4, 12)]
    assert made(env) == expected[:HORIZON]


def test_async_holds_still_when_the_chunk_is_used_up(env, instance):
    run_episode(env, instance, Driver(spec(mode="async"), Numbered(length=10, inference=0.25)))
    expected = ["-"] * 5 + [(1, index) for index in range(10)] + ["-"] * 3 + [(2, index) for index in range(2, 10)] + ["-"] * 3
    assert made(env)[: len(expected)] == expected


def test_async_asks_again_at_once_when_the_answer_is_older_than_execute(env, instance):
    run_episode(env, instance, Driver(spec(mode="async", execute=2), Numbered(length=12, inference=0.2)))
    expected = ["-"] * 4 + [(1, index) for index in range(6)] + [(2, index) for index in range(4, 8)] + [(3, index) for index in range(4, 8)]
    assert made(env)[: len(expected)] == expected


def test_noise_on_actions_is_of_the_repeat_and_spares_gripper_and_waiting(env, instance):
    def play(repeat, noise):
        env.load(instance)
        run_episode(env, instance, Driver(spec(mode="blocking"), Numbered(inference=0.2)), repeat=repeat, action_noise=noise)
        return np.array(env.made)

    clean, noisy, again, other = play(0, 0.0), play(0, 0.05), play(0, 0.05), play(1, 0.05)
    waiting = clean[:, 6] == 0.0
    assert waiting[:4].all()
    assert np.array_equal(noisy, again)
    assert not np.array_equal(noisy, other)
    assert np.array_equal(noisy[waiting], clean[waiting])
    assert np.array_equal(noisy[:, 6], clean[:, 6])
    assert 0.03 < (noisy - clean)[~waiting, :6].std() < 0.07


def test_a_chunk_shorter_than_execute_is_used_up(env, instance):
    outcome = run_episode(env, instance, Driver(spec(execute=8), Numbered(length=4)))
    assert outcome.calls == HORIZON / 4
    assert made(env)[:5] == [(1, 0), (1, 1), (1, 2), (1, 3), (2, 0)]


@pytest.mark.parametrize(
    ("seconds", "remote", "steps"),
    [(0.0, True, 0), (0.3, True, 6), (0.301, True, 7), (0.02, True, 1), (0.02, False, 0), (0.05, False, 0), (0.12, False, 3)],
)
def test_delay_in_steps(seconds, remote, steps):
    assert delay_steps(Call(np.zeros((1, 7), np.float32), inference=seconds), remote, 20) == steps


def test_a_failed_call_hands_over_to_the_fallback_for_the_rest(env, instance):
    fallback = Numbered()
    steps = Steps()
    driver = Driver(spec("large", mode="blocking"), Numbered(fail_at=2))
    outcome = run_episode(env, instance, driver, Driver(spec("small", price=Price(per_call=0.01)), fallback), [steps])
    assert outcome.fallback == "deadline"
    assert outcome.error is None
    assert made(env)[:8] == [(1, index) for index in range(8)]
    assert made(env)[8:13] == ["-"] * 5  # until the deadline
    assert {frame.policy for frame in steps.frames[:13]} == {"large"}
    assert {frame.policy for frame in steps.frames[13:]} == {"small"}
    assert (outcome.calls, outcome.actions) == (2, 8)
    assert outcome.fallback_steps == outcome.steps - 13
    assert outcome.price == pytest.approx(0.02 * 8 + 0.1 * 2 + 0.5 + 0.01 * fallback.calls)
    assert fallback.resets == [(instance.instruction, episode_seed(instance.key, "small", 0))]


def test_a_policy_that_is_never_reached_costs_time_and_no_call(env, instance):
    driver = Driver(spec("large", mode="blocking"), Numbered(fail_at=1, reached=False))
    outcome = run_episode(env, instance, driver, Driver(spec("small", price=Price()), Numbered()))
    assert (outcome.calls, outcome.actions, outcome.price, outcome.seconds.upload) == (0, 0, 0.0, 0.25)
    assert made(env)[:5] == ["-"] * 5


def test_a_failed_call_without_fallback_is_an_error(env, instance):
    outcome = run_episode(env, instance, Driver(spec("large", mode="blocking"), Numbered(fail_at=1)))
    assert outcome.error == "large: deadline"
    assert outcome.fallback is None and outcome.fallback_steps is None
    assert outcome.steps == 5


def test_an_exception_is_an_error_in_one_line(env, instance):
    steps = Steps()
    outcome = run_episode(env, instance, Driver(spec(), Numbered(raise_at=2)), Driver(spec("small"), Numbered()), [steps])
    assert outcome.error == "p: ZeroDivisionError: the policy has a bug"
    assert steps.outcome is outcome
    assert not outcome.success


def test_a_subscribers_trouble_is_not_the_policys(env, instance):
    class Full(Subscriber):
        def on_step(self, frame):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        run_episode(env, instance, Driver(spec(), Numbered()), subscribers=[Full()])


def test_real_time_takes_as_long_as_it_says(env, instance):
    start = time.perf_counter()
    outcome = run_episode(env, instance, Driver(spec(), Numbered()), subscribers=[RealTime()])
    assert time.perf_counter() - start >= outcome.seconds.motion


def test_success_ends_the_episode_and_video_changes_nothing(task, tmp_path, monkeypatch):
    env = TaskEnv(task)
    instance = make_instance(task, 0)
    env.load(instance)
    start = env.snapshot()
    ends = []
    monkeypatch.chdir(tmp_path)
    folder = Path("12:30:00")  # a protocol, to ffmpeg
    for subscribers in ([], [Video(folder / "a.mp4", quality="fast")]):
        env.restore(start)
        outcome = run_episode(env, instance, Driver(spec(execute=1), ExpertCaller(env)), subscribers=subscribers)
        ends.append((outcome, env.observe(("agentview",), 64)))
    (plain, seen), (filmed, seen_filmed) = ends
    assert plain.success
    assert plain.subgoals == 1.0
    assert plain.steps < task.horizon
    assert plain == filmed
    assert all(np.array_equal(seen[key], seen_filmed[key]) for key in seen)
    import imageio.v3

    film = imageio.v3.imread(folder.absolute() / "a.mp4")
    assert len(film) == pytest.approx(plain.steps / 2 + 11, abs=2)
    assert film[0][:80].max() > 200  # there is text
    assert [file.name for file in folder.iterdir()] == ["a.mp4"]
    env.close()


def test_seeds_depend_on_instance_policy_and_repeat():
    seeds = {episode_seed(key, policy, repeat) for key in ("a", "b") for policy in ("p", "q") for repeat in (0, 1)}
    assert len(seeds) == 8
    assert all(number >= 0 for seed in seeds for number in seed)
