"""Our server over real sockets, with our client and with openpi's."""

import threading
import time
import urllib.request

import numpy as np
import pytest
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from remote_helpers import ENVIRONMENT, GREETING, TOKEN, Sinusoid, observation, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from osel_sim.core.errors import PolicyError, RemoteError, UsageError
from osel_sim.core.proxies import is_loopback
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.codec import pack, unpack
from osel_sim.remote.protocol import RESET
from osel_sim.remote.server import PolicyServer, warm_up


@pytest.fixture(scope="module")
def url():
    with serving() as address:
        yield address


@pytest.fixture
def raw(url):
    with connect(url, additional_headers={"Authorization": f"Api-Key {TOKEN}"}, max_size=None) as connection:
        connection.recv(timeout=5)
        yield connection


def ask(connection, message):
    connection.send(message)
    return connection.recv(timeout=5)


def test_round_trip(url):
    with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5, expect=GREETING) as client:
        client.reset("stack the cubes")
        expected = Sinusoid()
        expected.reset("stack the cubes")
        for state in (0.25, -0.5):
            sent = observation("stack the cubes", state)
            answer = client.act(sent)
            np.testing.assert_array_equal(answer.actions, expected.act(sent))
            assert answer.actions.dtype == np.float32
            assert answer.bytes_up == len(pack(sent))
            assert answer.bytes_down == len(pack({"actions": answer.actions}))
            assert 0 < answer.measured_seconds < 5
        client.reset("stack the cubes")
        assert client.act(observation("stack the cubes")).actions[0, 1] == np.float32(0.01)


def test_openpis_own_client_is_served(url):
    client = WebsocketClientPolicy(url, api_key=TOKEN)
    metadata = client.get_server_metadata()
    assert metadata == GREETING.to_dict()
    reply = client.infer(observation("abc", 0.5))
    expected = Sinusoid()
    expected.reset("abc")
    np.testing.assert_array_equal(reply["actions"], expected.act(observation("abc", 0.5)))
    assert reply["server_timing"]["infer_ms"] >= 0
    # It knows no reset: another instruction starts a new episode.
    assert client.infer(observation("abc"))["actions"][0, 1] == np.float32(0.02)
    assert client.infer(observation("another"))["actions"][0, 1] == np.float32(0.01)
    with pytest.raises(RuntimeError, match=r"ObservationError: expected the keys .*observation\.state"):
        client.infer({"observation/exterior_image_1_left": np.zeros((224, 224, 3), np.uint8), "prompt": "x"})
    assert client.infer(observation("another"))["actions"][0, 1] == np.float32(0.02)


def test_several_clients_each_have_their_own_state(url):
    results: dict[int, list[float]] = {}

    def drive(index: int) -> None:
        with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=10) as client:
            client.reset("x" * index)
            chunks = [client.act(observation("x" * index)).actions for _ in range(10)]
        results[index] = [round(float(chunk[0, 0]) * 100) * 1000 + round(float(chunk[0, 1]) * 100) for chunk in chunks]

    threads = [threading.Thread(target=drive, args=(index,)) for index in range(1, 7)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert results == {index: [1000 * index + call for call in range(1, 11)] for index in range(1, 7)}


def get(url, path, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url.replace("ws:", "http:") + path, headers=headers), timeout=5) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_healthz_needs_no_token_and_nothing_else_goes_without(url):
    assert get(url, "/healthz") == (200, b"OK\n")
    assert get(url, "/")[0] == 401
    assert get(url, "/healthz/../", Authorization="")[0] == 401


@pytest.mark.parametrize("token", [None, "wrong-token", TOKEN + "x", TOKEN[:-1], TOKEN.upper()])
def test_a_wrong_token_is_refused(url, token):
    with pytest.raises(RemoteError, match=r"(refused the|wants a) token.*environment variable OSEL_SIM_TOKEN"):
        RemoteClient(url, ENVIRONMENT, token, timeout=5).connect()


@pytest.mark.parametrize("header", [TOKEN, f"Bearer {TOKEN}", f"api-key {TOKEN}", f"Api-Key  {TOKEN}", "Api-Key"])
def test_the_header_has_one_form(url, header):
    with pytest.raises(InvalidStatus), connect(url, additional_headers={"Authorization": header}):
        pass


def test_the_header_comes_once(url):
    with pytest.raises(InvalidStatus), connect(url, additional_headers=[("Authorization", f"Api-Key {TOKEN}")] * 2):
        pass


def change(**changes):
    value = observation()
    for key, item in changes.items():
        value[key.replace("__", ".")] = item
    return value


IMAGE, STATE = "observation__images__wrist", "observation__state"


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (b"\xc1garbage", "ProtocolError: not a msgpack frame"),
        ("text", "ProtocolError: expected a binary msgpack frame"),
        (pack([1, 2]), "ObservationError: an observation must be a map, got list"),
        (pack({}), "ObservationError: expected the keys"),
        (pack(change(extra=1)), "ObservationError: expected the keys"),
        (pack(change(**{IMAGE: np.zeros((32, 32, 3), np.float32)})), r"observation\.images\.wrist must be uint8 of shape \(32, 32, 3\), got float32"),
        (pack(change(**{IMAGE: np.zeros((3, 32, 32), np.uint8)})), r"got uint8 of shape \(3, 32, 32\)"),
        (pack(change(**{IMAGE: [1, 2, 3]})), r"observation\.images\.wrist must be an array, got list"),
        (pack(change(**{STATE: np.full(8, np.nan, np.float32)})), r"observation\.state contains NaN or infinity"),
        (pack(change(**{STATE: np.full(8, 1e300)})), r"observation\.state contains NaN or infinity"),
        (
            pack(change(**{STATE: np.zeros(7, np.float32)})),
            r"observation\.state must be float32 or float64 of shape \(8,\), got float32 of shape \(7,\)",
        ),
        (pack(change(task=5)), "an instruction must be a string, got int"),
        (pack(change(task="x" * 3000)), "an instruction has at most 2000 characters, got 3000"),
        (pack({RESET: 5}), "an instruction must be a string, got int"),
        (pack({RESET: "x", "task": "y"}), "a reset has the one key"),
    ],
)
def test_a_bad_message_gets_a_typed_answer_and_the_session_goes_on(raw, message, complaint):
    assert ask(raw, pack({RESET: "pick up the can"})) == pack({RESET: "pick up the can"})
    ask(raw, pack(observation()))
    reply = ask(raw, message)
    assert isinstance(reply, str) and "Traceback" not in reply and "\n" not in reply
    assert __import__("re").search(complaint, reply), reply
    assert unpack(ask(raw, pack(observation())))["actions"][0, 1] == np.float32(0.02)


def test_a_float64_state_is_fine(raw):
    assert unpack(ask(raw, pack(change(**{STATE: np.zeros(8)}))))["actions"].shape == (8, 7)


def test_an_oversize_message_closes_its_connection_and_no_other(url, raw):
    with RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5) as other:
        with pytest.raises(ConnectionClosed, match="1009"):
            raw.send(b"\0" * (3 << 20))
            raw.recv(timeout=5)
        other.reset("still here")


class Broken(Sinusoid):
    def act(self, observation):
        if observation["task"] == "fail":
            raise RuntimeError("secret path /home/somebody/weights")
        if observation["task"] == "nan":
            return np.full((8, 7), np.nan, np.float32)
        if observation["task"] == "slow":
            time.sleep(1.5)
        return super().act(observation) * (50 if observation["task"] == "large" else 1)


def test_a_failing_policy_tells_the_client_little_and_the_log_all(caplog):
    with serving(Broken) as url, RemoteClient(url, ENVIRONMENT, TOKEN, timeout=5) as client:
        with pytest.raises(RemoteError, match="reported an error: InternalError: the policy failed; its server's log says why") as caught:
            client.act(observation("fail"))
        assert "secret" not in str(caught.value)
        assert "secret path" in caplog.text
        client.reset("nan")
        with pytest.raises(RemoteError, match="PolicyError: actions contain NaN or infinity"):
            client.act(observation("nan"))
        client.reset("large")
        actions = client.act(observation("large")).actions
        assert actions.min() == -1 and actions.max() == 1


def test_health_and_other_clients_are_answered_during_an_inference():
    with serving(Broken) as url, RemoteClient(url, ENVIRONMENT, TOKEN, timeout=10) as slow:
        thread = threading.Thread(target=lambda: slow.act(observation("slow")))
        thread.start()
        time.sleep(0.2)
        start = time.monotonic()
        assert get(url, "/healthz")[0] == 200
        assert time.monotonic() - start < 1.0
        assert thread.is_alive()
        thread.join(10)


def test_an_inference_that_never_ends_does_not_keep_the_server(monkeypatch):
    monkeypatch.setattr("osel_sim.remote.server.CLOSE_SECONDS", 0.3)
    release = threading.Event()

    class Stuck(Sinusoid):
        def act(self, observation):
            release.wait(20)
            return super().act(observation)

    with serving(Stuck) as url:
        client = RemoteClient(url, ENVIRONMENT, TOKEN, timeout=0.3)
        client.connect()
        with pytest.raises(RemoteError, match=r"no answer within 0\.3 s"):
            client.act(observation())
    release.set()


def test_warm_up_refuses_a_policy_that_does_not_fit():
    class Wrong(Sinusoid):
        def act(self, observation):
            return np.zeros((8, 6), np.float32)

    class Failing(Sinusoid):
        def act(self, observation):
            raise KeyError("observation.images.front")

    warm_up(Sinusoid, GREETING)
    with pytest.raises(PolicyError, match=r"must have the shape \(T, 7\)"):
        warm_up(Wrong, GREETING)
    with pytest.raises(PolicyError, match=r"sinusoid: the first inference failed \(KeyError: 'observation.images.front'\)"):
        warm_up(Failing, GREETING)


@pytest.mark.parametrize("token", ["", "short", "with space in it", "ünicode-token", "x" * 300, "line\nbreak-token"])
def test_a_token_unfit_for_a_header_is_refused(token):
    with pytest.raises(UsageError, match="a token must be"):
        PolicyServer(Sinusoid, GREETING, token)


def test_loopback_is_told_from_the_world():
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "192.168.1.2", "example.org", ""))
