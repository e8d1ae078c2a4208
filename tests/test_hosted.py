"""Environments in a host process: what is asked arrives, and whatever a host does, nobody waits for ever or takes one answer for another."""

import contextlib
import math
import os
import signal
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import toy_host
from test_episode import spec
from toy_host import DIE, FAIL, HANG, Point
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as stock_connect

from osel_sim.core.errors import SuiteHostError, UsageError
from osel_sim.episodes.loop import Driver, run_episode
from osel_sim.interface.call import Call
from osel_sim.remote.codec import ProtocolError, pack, unpack
from osel_sim.suites import hosted
from osel_sim.suites.base import PlainInstance
from osel_sim.suites.environments import SuiteEnvironment
from osel_sim.suites.hosted import Host, HostedEnvironment, HostGoneError

INSTANCE = PlainInstance("toy:line", 3, "test", "move")


class ToyHost(Host):
    """A host of `toy_host.py`, with such manners."""

    def __init__(self, manners: str = "good") -> None:
        super().__init__("toy", SuiteEnvironment("gym"))
        self.manners = manners
        self.asked: list[str] = []

    def ask(self, message, life=None):
        self.asked.append(message["do"])
        return super().ask(message, life)

    def command(self, ready: int) -> list[str]:
        return [sys.executable, toy_host.__file__, str(ready), self.manners]


@pytest.fixture(scope="module")
def host():
    """One for the whole file; those who kill it leave it to the next to start it again."""
    with contextlib.closing(ToyHost()) as host:
        yield host


@pytest.fixture
def env(host):
    with contextlib.closing(HostedEnvironment(host, "line")) as env:
        env.load(INSTANCE)
        yield env


def chunk(*values: float):
    return np.array(values, np.float32)[:, None]


def test_it_is_the_environment_of_this_process_to_the_byte(env):
    here = Point()
    here.load(INSTANCE)
    for values in ([0.5, -0.25], [1.0] * 8):
        assert env.advance_chunk(chunk(*values)) == len(values)
        for action in chunk(*values):
            here.advance(action)
        there, expected = env.observe(["top"], 32), here.observe(["top"], 32)
        assert there.keys() == expected.keys() and all(np.array_equal(there[key], expected[key]) for key in expected)
        assert env.steps == here.steps and env.done == here.done
        there["observation.images.top"][0] = 0  # its own, and not what came over the wire


def test_what_is_to_be_looked_at_next_comes_with_the_chunk(env, host):
    here = Point()
    here.load(INSTANCE)

    def both(*values: float, look=None):
        assert (env.advance_and_look(chunk(*values), *look) if look else env.advance_chunk(chunk(*values))) == len(values)
        for action in chunk(*values):
            here.advance(action)

    def same(cameras, size: int):
        there, expected = env.observe(cameras, size), here.observe(cameras, size)
        there["observation.state"][:] += 0  # its own
        return all(np.array_equal(there[key], expected[key]) for key in expected)

    both(0.5, 0.25, look=(("top",), 32))
    host.asked.clear()
    assert same(["top"], 32) and same(("top",), 32) and host.asked == []
    assert same(["top"], 16) and same([], 32) and host.asked == ["observe"] * 2, "something else is asked for"
    both(-0.5)
    assert same(["top"], 32), "what was seen before the last chunk is not shown again"
    both(0.125, look=(("top",), 32))
    for world in (here, env):
        world.load(INSTANCE)
    assert same(["top"], 32), "nor before a reset"


class Still:
    """A policy that stays where it is, in chunks of eight."""

    def reset(self, instruction, seed):
        self.seen = []

    def call(self, observation):
        self.seen.append(observation)
        return Call(np.zeros((8, 1), np.float32))

    def close(self):
        pass


@pytest.mark.parametrize("execute", [8, 1])
def test_an_episode_asks_once_a_chunk_and_sees_what_it_sees_in_this_process(execute, env, host):
    driver = Driver(replace(spec("still", execute=execute), cameras=("top",)), Still())
    host.asked.clear()
    outcome = run_episode(env, INSTANCE, driver)
    assert host.asked == ["observe"] + ["advance"] * math.ceil(100 / execute)
    there, here = driver.caller.seen, Point()
    here.load(INSTANCE)
    assert run_episode(here, INSTANCE, driver) == outcome and len(there) == len(driver.caller.seen)
    for one, other in zip(there, driver.caller.seen, strict=True):
        assert all(np.array_equal(one[key], other[key]) for key in other)


def test_an_episode_that_is_over_draws_nothing_more(env, host):
    left = env.specification.horizon - env.steps
    assert env.advance_and_look(chunk(*[0.0] * (left + 5)), ["top"], 32) == left and env.done
    host.asked.clear()
    env.observe(["top"], 32)
    assert host.asked == ["observe"]


def test_what_cannot_be_shown_is_told_to_whoever_looks(env):
    assert env.advance_and_look(chunk(0.5), ["no such camera"], -1) == 1 and env.steps == 1
    with pytest.raises(SuiteHostError, match="the host of suite 'toy'"):
        env.observe(["no such camera"], -1)


def test_it_needs_no_threads_and_leaves_no_process_behind(host):
    before = threading.enumerate()
    HostedEnvironment(host, "line").load(INSTANCE)
    assert threading.enumerate() == before, "a message that changes threads takes twice as long"
    pid = host.pid
    host.close()
    host.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_host_that_is_killed_at_a_question_is_an_error_and_the_next_instance_has_a_fresh_one(env):
    pid = env._host.pid
    with pytest.raises(HostGoneError, match="the host of suite 'toy' has ended"):
        env.advance_chunk(chunk(0.5, DIE))
    with pytest.raises(HostGoneError):
        env.observe(["top"], 32)
    env.load(INSTANCE)
    assert env.observe([], 32)["observation.state"] == [3.0] and env._host.pid != pid
    os.kill(env._host.pid, signal.SIGKILL)
    assert env.observe([], 32)["observation.state"] == [3.0], "nothing has moved yet: nobody need know"


def test_a_host_that_does_not_answer_is_given_up(env, monkeypatch):
    monkeypatch.setattr(hosted, "ANSWER_SECONDS", 0.3)
    start, pid = time.monotonic(), env._host.pid
    with pytest.raises(HostGoneError, match=r"does not answer within 0\.3 s"):
        env.advance_chunk(chunk(HANG))
    assert time.monotonic() - start < 5
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize(
    ("manners", "message"),
    [
        ("half", "the host of suite 'toy' has ended"),
        ("text", r"hung up \(expected a binary message in one frame\)"),
        ("foreign", r"speaks .*another/1.*, expected osel_sim\.suite/1"),
        ("mute", "timed out"),
    ],
)
def test_a_host_that_breaks_the_protocol_is_an_error(manners, message, monkeypatch):
    with contextlib.closing(ToyHost(manners)) as host:
        if manners == "mute":
            monkeypatch.setattr(hosted, "START_SECONDS", 0.3)
        with pytest.raises(HostGoneError, match=message):
            host.ask({"do": "open", "task": "line"})
        assert not host.running


def test_what_fails_there_is_told_and_the_host_goes_on(env):
    pid = env._host.pid
    with pytest.raises(SuiteHostError, match="the host of suite 'toy': ValueError: the point broke"):
        env.advance_chunk(chunk(FAIL))
    with pytest.raises(UsageError, match="has no snapshots"):
        env.snapshot()
    with pytest.raises(UsageError, match=r"cannot be sent: it has 75,000,\d+ bytes, more than 67,108,864"):
        env.image("top", 5000, 5000)
    with pytest.raises(ProtocolError, match=r"cannot be sent: it has 80,000,\d+ bytes"):
        env.advance_chunk(np.zeros((20_000_000, 1)))
    assert env.image("top", 2000, 2000).shape == (2000, 2000, 3) and env._host.pid == pid


def test_an_answer_that_was_not_waited_for_is_not_taken_for_the_next(env):
    def interrupt(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        with pytest.raises(KeyboardInterrupt):
            env.advance_chunk(chunk(HANG))
    finally:
        signal.signal(signal.SIGALRM, before)
    env.load(INSTANCE)
    assert env.observe([], 32)["observation.state"] == [3.0]


def test_any_websocket_client_with_the_token_is_answered_and_no_other(host):
    host.close()
    host.start()
    for headers in ({}, {"Authorization": "Api-Key wrong"}, {"Authorization": f"Bearer {host.token}"}):
        with pytest.raises(InvalidStatus, match="401"):
            stock_connect(host.url, additional_headers=headers, proxy=None)
    with stock_connect(host.url, additional_headers={"Authorization": f"Api-Key {host.token}"}, proxy=None) as client:
        client.send(pack({"do": "open", "task": "line"}))
        assert unpack(client.recv())["env"] == 0
    assert host.ask({"do": "open", "task": "line"})["env"] == 0, "another client may come when one has gone"
