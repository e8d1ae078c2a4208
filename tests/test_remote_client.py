"""Our client against servers that are dead, slow or lying: always a RemoteError that says why, always in time."""

import contextlib
import socket
import threading
import time

import msgpack
import numpy as np
import pytest
from openpi_client import msgpack_numpy
from remote_helpers import ENVIRONMENT, GREETING, TOKEN, Sinusoid, observation, serving, serving_with

from osel_sim.core.errors import RemoteError
from osel_sim.remote.client import RemoteClient
from osel_sim.remote.codec import pack, unpack
from osel_sim.remote.protocol import RESET, Greeting


@contextlib.contextmanager
def raises_soon(reason, seconds=3.0):
    start = time.monotonic()
    with pytest.raises(RemoteError, match=reason):
        yield
    assert time.monotonic() - start < seconds


@contextlib.contextmanager
def tcp_server(reply=b""):
    """Accepts, says `reply` once, then nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        connections = []

        def accept():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    connections.append(connection)
                    if reply:
                        connection.sendall(reply)

        thread = threading.Thread(target=accept)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join(5)
            for connection in connections:
                connection.close()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def test_nobody_there():
    with raises_soon("Connection refused"):
        RemoteClient(f"ws://127.0.0.1:{free_port()}", ENVIRONMENT, timeout=2).connect()
    with raises_soon("cannot connect"):
        RemoteClient("ws://no-such-host.invalid:80", ENVIRONMENT, timeout=2).connect()


@pytest.mark.parametrize("url", ["", "http://127.0.0.1:1", "ws://", "no url", "ws://127.0.0.1:99999"])
def test_no_address(url):
    with raises_soon("is no WebSocket server|cannot connect"):
        RemoteClient(url, ENVIRONMENT, timeout=2).connect()


def test_a_server_that_accepts_and_says_nothing():
    with tcp_server() as url, raises_soon(r"no connection within 0\.5 s"):
        RemoteClient(url, ENVIRONMENT, timeout=0.5).connect()


@pytest.mark.parametrize(
    "reply", [b"SSH-2.0-OpenSSH_9.2\r\n", b"\0" * 100, b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n", b"HTTP/1.1 500 Oops\r\n\r\n"]
)
def test_a_server_of_something_else(reply):
    with tcp_server(reply) as url, raises_soon("is no WebSocket server|answered HTTP|no connection"):
        RemoteClient(url, ENVIRONMENT, timeout=0.4).connect()


@pytest.mark.parametrize(
    ("greeting", "reason"),
    [
        (b"garbage", "its greeting is unreadable: not a msgpack frame"),
        (pack([1]), "the greeting must be a map, got list"),
        ("Traceback (most recent call last):\n  ...\nOSError: no GPU", "reported an error: OSError: no GPU"),
        (pack({**GREETING.to_dict(), "protocol": "osel_sim/99"}), "speaks 'osel_sim/99', this client 'osel_sim/1'"),
        (
            pack({**GREETING.to_dict(), "action_dim": 14}),
            r"its actions and states have 14 and 8 numbers, those of the .* osel_sim 7 and 8",
        ),
        (pack({**GREETING.to_dict(), "cameras": "agentview"}), "lacks policy, cameras, image_size, action_dim or state_dim"),
        (pack({**GREETING.to_dict(), "policy": "another"}), r"serves Greeting\(policy='another'.*expected Greeting\(policy='sinusoid'"),
        (pack({**GREETING.to_dict(), "image_size": 64}), "image_size=64"),
    ],
)
def test_a_greeting_we_cannot_work_with(greeting, reason):
    with serving_with(lambda connection: connection.recv(timeout=5), greeting) as url:
        client = RemoteClient(url, ENVIRONMENT, timeout=2, expect=GREETING)
        with raises_soon(reason):
            client.connect()
        assert not client.connected


def test_no_greeting():
    with serving_with(lambda connection: None, b"") as url, raises_soon("greeting"):
        RemoteClient(url, ENVIRONMENT, timeout=1).connect()


GOOD = np.zeros((8, 7), np.float32)


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        (b"\xc1", "its answer is unreadable: not a msgpack frame"),
        (b"", "not a msgpack frame"),
        (pack([GOOD]), "answered without actions"),
        (pack({"action": GOOD}), "answered without actions"),
        (pack({"actions": GOOD[:, :6]}), r"must have the shape \(T, 7\) with 1 <= T <= 1000, got \(8, 6\)"),
        (pack({"actions": GOOD[0]}), r"got \(7,\)"),
        (pack({"actions": GOOD[:0]}), r"got \(0, 7\)"),
        (pack({"actions": np.zeros((1001, 7), np.float32)}), r"got \(1001, 7\)"),
        (pack({"actions": np.where(GOOD == 0, np.nan, GOOD)}), "actions contain NaN or infinity"),
        (pack({"actions": GOOD.astype(np.float64) + np.inf}), "actions contain NaN or infinity"),
        (pack({"actions": GOOD.astype(bool)}), "must be real numbers, got dtype bool"),
        (pack({"actions": "forward"}), "must be real numbers"),
        (pack({"actions": {"x": 1}}), "must be real numbers"),
        (pack({"actions": [[1.0], [1.0, 2.0]]}), "actions are not an array"),
        (msgpack.packb({"actions": {b"__ndarray__": True, b"data": b"\x80\x04N.", b"dtype": "|O", b"shape": [1]}}), "dtype '|O' is not allowed"),
        ("Traceback (most recent call last):\n ...\nValueError: bad shape", "reported an error: ValueError: bad shape"),
        ("", "reported an error"),
    ],
)
def test_a_lying_server(reply, reason):
    def answer(connection):
        for message in connection:
            connection.send(message if RESET in str(unpack(message)) else reply)

    with serving_with(answer) as url, RemoteClient(url, ENVIRONMENT, timeout=2) as client:
        client.reset("x")
        with raises_soon(reason.replace("|O", r"\|O")):
            client.act(observation())
        assert not client.connected
        with pytest.raises(RemoteError, match="not connected"):
            client.act(observation())
        client.reset("again")
        assert client.connected


@pytest.mark.parametrize(
    ("extra", "reason"),
    [
        (pack({"actions": GOOD}), "sent a message that nobody asked for"),
        (b"", "sent a message that nobody asked for"),
        ("Traceback\nCUDA error: out of memory", "reported an error: CUDA error: out of memory"),
    ],
)
@pytest.mark.parametrize("greeting", [None, pack({"model": "pi0"})])
def test_what_lies_ready_before_a_question_is_no_answer_to_it(extra, reason, greeting):
    def answer(connection):
        for message in connection:
            connection.send(message if RESET in str(unpack(message)) else pack({"actions": GOOD}))
            connection.send(extra)

    with serving_with(answer, greeting) as url, RemoteClient(url, ENVIRONMENT, timeout=2) as client:
        client.act(observation())
        time.sleep(0.2)
        with raises_soon(reason):
            client.act(observation())
        assert not client.connected
        client.reset("a new connection")
        time.sleep(0.2)
        if not client.foreign:  # a server that is not ours was asked nothing yet
            with raises_soon(reason):
                client.act(observation())


def test_actions_out_of_range_are_clipped():
    def answer(connection):
        for _ in connection:
            connection.send(pack({"actions": np.linspace(-3, 3, 56).reshape(8, 7)}))

    with serving_with(answer) as url, RemoteClient(url, ENVIRONMENT, timeout=2) as client:
        actions = client.act(observation()).actions
        assert actions.dtype == np.float32 and actions.min() == -1.0 and actions.max() == 1.0
        assert np.abs(actions).min() < 0.1


def test_a_wrong_answer_to_a_reset():
    def answer(connection):
        for _ in connection:
            connection.send(pack({"actions": GOOD}))

    with serving_with(answer) as url, RemoteClient(url, ENVIRONMENT, timeout=2) as client, raises_soon("answered a reset with something else"):
        client.reset("x")


def test_a_server_that_hangs():
    release = threading.Event()

    def hang(connection):
        release.wait(10)

    with serving_with(hang) as url, RemoteClient(url, ENVIRONMENT, timeout=0.5) as client:
        with raises_soon(r"no answer within 0\.5 s"):
            client.act(observation())
        release.set()


def test_a_server_that_stops_reading_cannot_block_the_sender():
    # More than all buffers in between hold, and nobody reads: sending itself must give up.
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def handshake():
            import base64
            import hashlib

            connection, _ = listener.accept()
            key = connection.recv(4096).decode().split("Sec-WebSocket-Key: ")[1].split("\r\n")[0]
            accept = base64.b64encode(hashlib.sha1((key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11").encode()).digest()).decode()
            greeting = pack({})
            lines = "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
            connection.sendall((lines + accept + "\r\n\r\n").encode() + bytes([0x82, len(greeting)]) + greeting)
            return connection

        accepted = []
        thread = threading.Thread(target=lambda: accepted.append(handshake()))
        thread.start()
        url = f"ws://127.0.0.1:{listener.getsockname()[1]}"
        with RemoteClient(url, ENVIRONMENT, timeout=0.5) as client, raises_soon(r"took no message within 0\.5 s", 10.0):
            client.act({**observation(), "observation.images.wrist": np.zeros(16 << 20, np.uint8)})
        thread.join(5)
        accepted[0].close()


def test_a_server_that_dies_in_the_middle():
    def answer_once(connection):
        connection.recv(timeout=5)
        connection.send(pack({"actions": GOOD}))
        connection.recv(timeout=5)
        connection.socket.shutdown(socket.SHUT_RDWR)

    with serving_with(answer_once) as url, RemoteClient(url, ENVIRONMENT, timeout=2) as client:
        client.act(observation())
        with raises_soon("closed the connection"):
            client.act(observation())


def test_an_endless_answer():
    def flood(connection):
        connection.recv(timeout=5)
        with contextlib.suppress(Exception):
            connection.send(b"\0" * (17 << 20))

    with serving_with(flood) as url, RemoteClient(url, ENVIRONMENT, timeout=3) as client, raises_soon("closed the connection"):
        client.act(observation())


def test_a_plain_openpi_server_gets_no_reset():
    seen = []

    def openpi(connection):
        for message in connection:
            seen.append(msgpack_numpy.unpackb(message))
            timing = {"infer_ms": 12.3} if len(seen) == 1 else {"infer_ms": 4.5, "prev_total_ms": 20.0}
            connection.send(
                msgpack_numpy.packb({"actions": np.ones((50, 7)), "state": np.zeros(8), "server_timing": timing, "policy_timing": timing})
            )

    with serving_with(openpi, pack({"model": "pi0"})) as url, RemoteClient(url, ENVIRONMENT, timeout=2, expect=GREETING) as client:
        client.reset("x")
        first, second = client.act(observation()), client.act(observation())
        assert first.actions.shape == (50, 7)
        # Timings are not part of what is billed: they differ from call to call.
        assert first.bytes_down == second.bytes_down
    assert [sorted(item) for item in seen] == [sorted(observation())] * 2


def test_reconnects_with_the_next_episode():
    with serving(Sinusoid) as url:
        client = RemoteClient(url, ENVIRONMENT, TOKEN, timeout=2)
        for _ in range(3):
            client.reset("x")
            assert client.act(observation("x")).actions[0, 1] == np.float32(0.01)
            client.close()
            client.close()
            assert not client.connected


def test_greetings_survive_the_wire():
    assert Greeting.parse(unpack(pack(GREETING.to_dict()))) == GREETING
    assert Greeting.parse({"model": "pi0"}) is None
