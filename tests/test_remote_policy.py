"""Client, virtual network, deadline and server process together."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from remote_helpers import ENVIRONMENT, GREETING, TOKEN, Sinusoid, alive, install_plugin, observation, policy_spec, serving, serving_with

from osel_sim.core.errors import RemoteError, UsageError
from osel_sim.interface.call import Call
from osel_sim.policy.local import LocalCaller
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.codec import pack
from osel_sim.remote.network import PROFILES, NetworkModel, NetworkProfile
from osel_sim.remote.policy import RemotePolicy, check_servers, open_remote
from osel_sim.remote.policy_process import PolicyServerProcess


@pytest.fixture(scope="module")
def url():
    with serving() as address:
        yield address


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    install_plugin(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    return tmp_path


def episode(url, spec, seed, network=None, calls=6):
    """Calls without what was measured, which alone may differ from run to run."""
    remote = RemotePolicy(spec, RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5), network)
    remote.reset("pick up the can", seed)
    results = [remote.call(observation(state=index / 10)) for index in range(calls)]
    remote.close()
    return results


def timing(call):
    return call.upload, call.inference, call.download, call.megabytes, call.failure


def test_a_call_has_the_servers_actions_and_the_models_delays(url, tmp_path):
    calls = episode(url, policy_spec(tmp_path), (1, 2, 3))
    expected, network = Sinusoid(), NetworkModel(PROFILES["wifi"], (1, 2, 3))
    expected.reset("pick up the can")
    for index, call in enumerate(calls):
        sent = observation(state=index / 10)
        np.testing.assert_array_equal(call.actions, expected.act(sent))
        size_up, size_down = len(pack(sent)), len(pack({"actions": call.actions}))
        delays = network.delays(size_up, 0.1, size_down)
        assert timing(call) == (delays.upload, delays.inference, delays.download, pytest.approx((size_up + size_down) / 1e6), None)
        assert call.seconds == pytest.approx(delays.total)
        assert 0 < call.measured_seconds < 5


def test_delays_are_the_same_again_and_differ_by_seed(url, tmp_path):
    spec = policy_spec(tmp_path)
    first = [timing(call) for call in episode(url, spec, (4, 0, 1))]
    assert first == [timing(call) for call in episode(url, spec, (4, 0, 1))]
    assert first != [timing(call) for call in episode(url, spec, (4, 0, 2))]


def test_only_the_policys_own_cameras_travel(url, tmp_path):
    extra = {**observation(), "observation.images.front": np.zeros((640, 640, 3), np.uint8), "privileged": object()}
    remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5))
    remote.reset("x", (0,))
    assert remote.call(extra).failure is None
    remote.close()


def test_price_is_per_action_call_and_megabyte(url, tmp_path):
    spec = policy_spec(tmp_path)
    calls = episode(url, spec, (0,), calls=3)
    megabytes = sum(call.megabytes for call in calls)
    sent, answer = len(pack(observation())), len(pack({"actions": np.zeros((8, 7), np.float32)}))
    assert megabytes == pytest.approx(3 * (sent + answer) / 1e6)
    assert spec.price.of(actions=12, calls=3, megabytes=megabytes) == pytest.approx(0.01 * 12 + 0.5 * 3 + 2.0 * megabytes)


def test_a_call_over_its_deadline_failed_and_took_as_long_as_the_deadline(url, tmp_path):
    spec = policy_spec(tmp_path, deadline=0.12)
    calls = episode(url, spec, (5,), PROFILES["lte"])
    assert {call.failure for call in calls} == {"deadline"}
    for call in calls:
        assert call.actions is None
        assert call.seconds == pytest.approx(0.12)
        assert call.upload > 0 and call.inference > 0 and call.download >= 0
        assert call.megabytes > 0
    # A missed deadline does not end the connection: with more time the same luck is enough.
    assert {call.failure for call in episode(url, policy_spec(tmp_path, deadline=30.0), (5,), PROFILES["lte"])} == {None}


def test_an_outage_is_told_from_a_slow_network_and_comes_at_the_same_calls(url, tmp_path):
    breaking = NetworkProfile(100.0, 100.0, 0.02, outage=0.4, outage_seconds=1000.0)
    first, again = (episode(url, policy_spec(tmp_path), (9,), breaking, calls=30) for _ in range(2))
    assert [timing(call) for call in first] == [timing(call) for call in again]
    assert {call.failure for call in first} == {None, "outage"}
    assert all(call.seconds == pytest.approx(2.0) for call in first if call.failure)
    assert all(call.seconds < 0.3 for call in first if not call.failure)
    short = NetworkProfile(100.0, 100.0, 0.02, outage=0.4, outage_seconds=1e-4)
    assert {call.failure for call in episode(url, policy_spec(tmp_path), (9,), short, calls=30)} == {None}


def test_a_lying_server_fails_the_rest_of_the_episode_and_the_next_one_tries_again(tmp_path):
    episodes = []

    def answer(connection):
        episodes.append(None)
        for message in connection:
            nan = len(episodes) == 1
            connection.send(message if b"osel_sim/reset" in message else pack({"actions": np.full((4, 7), np.nan if nan else 0.5)}))

    with serving_with(answer) as url:
        remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, timeout=2))
        remote.reset("x", (1,))
        for _ in range(2):
            call = remote.call(observation())
            assert (call.failure, call.seconds, call.actions) == ("actions contain NaN or infinity", 2.0, None)
        remote.reset("x", (2,))
        assert remote.call(observation()).actions.shape == (4, 7)
        remote.close()


@pytest.mark.parametrize(("how", "answers"), [("hangs up", 2), ("goes silent", 2), ("hangs up after the reset", 0), ("mid-episode", 1)])
def test_the_first_call_of_an_episode_is_repeated_once_where_the_connection_had_died(tmp_path, how, answers):
    """A stranger's server or a proxy drops idle connections; it knows no reset, so that only the next question shows it."""
    connections = []

    def answer(connection):
        connections.append(connection)
        for number, _ in enumerate(connection):
            if len(connections) > 1 or number < answers:
                connection.send(pack({"actions": np.full((4, 7), 0.5)}))
            if len(connections) == 1 and number == answers - 1 and how == "hangs up":
                return
            if len(connections) == 1 and number == answers and how != "goes silent":
                return

    with serving_with(answer, pack({})) as url:
        remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, timeout=0.5))
        remote.reset("x", (1,))
        failures = [remote.call(observation()).failure for _ in range(2)]
        if how == "mid-episode":
            assert failures[0] is None and "closed the connection" in failures[1]
        else:
            assert failures == [None, None]
        remote.reset("x", (2,))
        assert [remote.call(observation()).failure for _ in range(2)] == [None, None]
        assert len(connections) == 2
        remote.close()


def test_a_server_that_never_answers_is_asked_once_an_episode(tmp_path):
    asked = []

    def answer(connection):
        asked.extend(connection)

    with serving_with(answer, pack({})) as url:
        remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, timeout=0.2))
        for episode in range(2):
            remote.reset("x", (episode,))
            assert "no answer within 0.2 s" in remote.call(observation()).failure
        remote.close()
        assert len(asked) == 2


def test_the_time_for_an_answer_is_a_key_of_the_policy_file(tmp_path):
    with serving_with(lambda connection: time.sleep(1.0), pack({})) as url:
        spec = policy_spec(tmp_path, url=f'{url}"\ntimeout = 0.15\n#')
        assert spec.remote.timeout == 0.15
        with pytest.raises(RemoteError, match="no answer within"):
            open_remote(spec, ENVIRONMENT, start_timeout=0.2)


def test_a_server_that_is_gone_fails_calls_not_resets(tmp_path):
    with serving() as url:
        remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, TOKEN, timeout=2))
        remote.reset("x", (1,))
        assert remote.call(observation("x")).failure is None
    call = remote.call(observation("x"))
    assert "closed the connection" in call.failure and call.seconds == 2.0
    assert "127.0.0.1" not in call.failure  # goes into the journal, where a random port must not be
    remote.reset("x", (2,))
    unreached = remote.call(observation("x"))
    assert "Connection refused" in unreached.failure and unreached.seconds == 2.0
    assert unreached.sent is False  # the first one may have been written before its connection was known to be closed
    remote.close()


def test_a_question_without_an_answer_was_a_call(tmp_path):
    with serving_with(lambda connection: connection.recv(timeout=5), pack({"model": "pi0"})) as url:
        remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, timeout=2))
        remote.reset("x", (1,))
        call = remote.call(observation("x"))
        assert "closed the connection" in call.failure and call.sent
        assert not remote.call(observation("x")).sent
        remote.close()


def test_a_call_before_any_reset_fails(tmp_path):
    assert RemotePolicy(policy_spec(tmp_path), RemoteClient("ws://127.0.0.1:1", ENVIRONMENT)).call(observation()).failure == "no episode was started"


def test_a_missing_observation_is_a_bug_to_be_seen(url, tmp_path):
    remote = RemotePolicy(policy_spec(tmp_path), RemoteClient(url, ENVIRONMENT, TOKEN, timeout=2))
    remote.reset("x", (1,))
    with pytest.raises(Exception, match=r"the observation lacks observation\.images\.wrist"):
        remote.call({key: value for key, value in observation().items() if "wrist" not in key})
    remote.close()


def test_a_local_policy_is_called_the_same_way(tmp_path):
    caller = LocalCaller(Sinusoid(), policy_spec(tmp_path), ENVIRONMENT)
    caller.reset("abc", (1, 2))
    call = caller.call(observation("abc"))
    assert call.actions[0, 0] == np.float32(0.03)
    assert timing(call) == (0, 0.1, 0, 0, None)

    class Wrong(Sinusoid):
        def act(self, observation):
            return np.full((8, 7), math.nan)

    call = LocalCaller(Wrong(), policy_spec(tmp_path), ENVIRONMENT).call(observation())
    assert (call.actions, call.failure, call.seconds) == (None, "actions contain NaN or infinity", 0.1)
    with pytest.raises(ValueError, match="either actions or a failure"):
        Call(None)


def test_own_server_process_answers_and_is_gone_afterwards(plugin):
    remote = open_remote(policy_spec(plugin), ENVIRONMENT, timeout=10, start_timeout=60)
    process = remote._server
    assert process.running
    assert TOKEN not in process.token and len(process.token) > 30
    command = Path(f"/proc/{process.pid}/cmdline")
    if command.exists():
        assert process.token not in command.read_text()
    remote.reset("pick up the can", (1, 2, 3))
    call = remote.call(observation())
    expected = Sinusoid()
    expected.reset("pick up the can")
    np.testing.assert_array_equal(call.actions, expected.act(observation()))

    # Killed in the middle of an episode: this one fails, the next has a new server.
    os.kill(process.pid, signal.SIGKILL)
    process._process.wait(5)
    call = remote.call(observation())
    assert "closed the connection" in call.failure and call.seconds == 2.0
    remote.reset("pick up the can", (1, 2, 4))
    assert remote.call(observation()).failure is None

    # Hanging: likewise.
    remote._client._timeout = 1.0
    os.kill(process.pid, signal.SIGSTOP)
    assert "no answer within 1 s" in remote.call(observation()).failure
    os.kill(process.pid, signal.SIGCONT)
    pid = process.pid
    remote.close()
    remote.close()
    assert not process.running
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("broken", "the weights are on holiday"),
        ("missing", "policy kind 'missing' of the package toy-policies 1.0: cannot import toy_policies:none"),
        ("sinusiod", "unknown policy kind 'sinusiod': did you mean 'sinusoid'"),
    ],
)
def test_a_server_that_does_not_start_says_why(plugin, kind, reason):
    start = time.monotonic()
    with pytest.raises(RemoteError, match=reason), PolicyServerProcess(policy_spec(plugin, kind=kind), ENVIRONMENT, start_timeout=60):
        pass
    assert time.monotonic() - start < 30


@pytest.mark.parametrize("kind", ["chatty", "chatty_broken"])
def test_what_a_plugin_prints_while_it_loads_is_not_the_servers_word(plugin, kind):
    server = PolicyServerProcess(policy_spec(plugin, kind=kind), ENVIRONMENT, timeout=10, start_timeout=60)
    if kind == "chatty":
        with server, server.start_client() as client:
            assert client.act(observation()).actions.shape == (8, 7)
        return
    with pytest.raises(RemoteError, match="the weights are on holiday"):
        server.start()


def test_a_server_that_takes_too_long_to_start(plugin):
    server = PolicyServerProcess(policy_spec(plugin), ENVIRONMENT, start_timeout=0.01)
    with pytest.raises(RemoteError, match=r"not ready within 0\.01 s"):
        server.start()
    assert not server.running


def test_the_server_dies_with_its_parent_however_that_dies(plugin):
    policy_spec(plugin)
    script = (
        "import sys, time\nfrom pathlib import Path\nfrom osel_sim.formats.policy_file import load_policy_file\n"
        "from osel_sim.remote.policy_process import PolicyServerProcess\nfrom osel_sim.interface.specification import specification\n"
        "server = PolicyServerProcess(load_policy_file(Path(sys.argv[1])), specification())\nserver.start()\n"
        "print(server.pid, flush=True)\ntime.sleep(1000)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script, str(plugin / "sinusoid.toml")], stdout=subprocess.PIPE, text=True)
    pid = int(parent.stdout.readline())
    os.kill(pid, 0)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(100):
        if not alive(pid):
            return
        time.sleep(0.1)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("the server outlived its parent")


def test_a_server_of_somebody_else(tmp_path, url, monkeypatch):
    monkeypatch.setenv("OSEL_SIM_TOKEN", TOKEN)
    remote = open_remote(policy_spec(tmp_path, url=url), ENVIRONMENT, timeout=5)
    remote.reset("x", (1,))
    assert remote.call(observation("x")).failure is None
    remote.close()
    with pytest.raises(RemoteError, match=r"serves Greeting.*expected Greeting"):
        open_remote(policy_spec(tmp_path, name="other", url=url), ENVIRONMENT, timeout=5)
    monkeypatch.delenv("OSEL_SIM_TOKEN")
    for reach in (open_remote, lambda spec, environment, timeout: check_servers([spec], environment, timeout)):
        with pytest.raises(RemoteError, match=r"policy 'sinusoid' \(.*\): .*: wants a token: put it into the environment variable OSEL_SIM_TOKEN"):
            reach(policy_spec(tmp_path, url=url), ENVIRONMENT, timeout=5)
    check_servers([policy_spec(tmp_path)], ENVIRONMENT)  # one that would be started here is not tried
    assert GREETING.policy == "sinusoid"


def test_a_local_policy_file_cannot_be_opened_as_remote(tmp_path):
    file = tmp_path / "here.toml"
    file.write_text(
        'version = 1\nname = "here"\ntitle = "x"\nlocation = "local"\nkind = "lerobot"\nexecute = 1\ninference_seconds = 0\n'
        '[observation]\ncameras = ["agentview"]\nimage_size = 32\n'
    )
    from osel_sim.formats.policy_file import load_policy_file

    with pytest.raises(UsageError, match="is not a remote policy"):
        open_remote(load_policy_file(file), ENVIRONMENT)
