"""The wire to a host process, both ends in this process: what is not a whole message in time, from who may send it, is an error."""

import contextlib
import socket
import threading
import time

import pytest
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidMessage, WebSocketException
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

from osel_sim.remote.codec import ProtocolError
from osel_sim.suites.wire import LARGEST, Wire

TOKEN = "secret-enough"


@pytest.fixture
def connected():
    """Two sockets that are connected on loopback."""
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()) as one, listener.accept()[0] as other:
        yield one, other


@pytest.fixture
def client(connected):
    """The asking end, behind its handshake; the other is the plain socket of `connected`."""
    return Wire(connected[0], ClientProtocol(parse_uri("ws://here"), state=State.OPEN, max_size=LARGEST))


@pytest.fixture
def server(connected):
    """The answering end."""
    return Wire(connected[1], ServerProtocol(state=State.OPEN, max_size=LARGEST))


@contextlib.contextmanager
def beside(function):
    """Run a function in a thread meanwhile."""
    thread = threading.Thread(target=function)
    thread.start()
    yield
    thread.join(10)
    assert not thread.is_alive()


@pytest.mark.parametrize("size", [0, 1, 125, 126, 65_536, 1_000_000])
def test_messages_of_every_length_arrive_whole_and_in_order(size, client, server):
    message = bytes(range(256)) * (size // 256) + bytes(size % 256)

    def answer():
        for _ in range(2):
            server.send(server.receive(10.0) + b"!", 10.0)

    with beside(answer):
        for part in (b"a", b"b"):
            client.send(part + message, 10.0)
            assert client.receive(10.0) == part + message + b"!"


def test_a_connection_needs_the_token():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url, accepted = f"ws://127.0.0.1:{listener.getsockname()[1]}", []

        def accept():
            for _ in range(2):
                connection, _ = listener.accept()
                try:
                    accepted.append(Wire.accept(connection, TOKEN, 5.0))
                except WebSocketException as error:
                    connection.close()
                    accepted.append(error)

        with beside(accept):
            with pytest.raises(InvalidHandshake, match="401"):
                Wire.connect(url, "something-else", 5.0)
            client = Wire.connect(url, TOKEN, 5.0)
        assert isinstance(accepted[0], InvalidHandshake)
        accepted[1].send(b"welcome")
        assert client.receive(5.0) == b"welcome"
        client.close()
        with pytest.raises(ConnectionClosed):
            accepted[1].receive(5.0)
        accepted[1].close()


@pytest.mark.parametrize(
    ("said", "error"),
    [
        (b"", TimeoutError),
        (b"GET / HTTP/1.1\r\nAuth", TimeoutError),
        (b"\x00\xff\r\n\r\n", InvalidMessage),
        (b"GET / HTTP/1.1\r\n\r\n", InvalidHandshake),
    ],
)
def test_who_does_not_ask_properly_is_not_waited_for(said, error, connected):
    connected[0].sendall(said)
    with pytest.raises(error):
        Wire.accept(connected[1], TOKEN, 0.2)


def test_half_a_message_is_an_error_when_the_other_end_is_gone_and_when_time_is_up(client, connected):
    other = connected[1]
    half = b"\x82\x7e\x10\x00" + bytes(100)  # a binary frame of 4,096 bytes begins
    other.sendall(half)
    with pytest.raises(TimeoutError):
        client.receive(0.1)
    other.close()
    with pytest.raises(ConnectionClosed):
        client.receive(5.0)


def test_time_is_counted_for_the_whole_message(client, connected):
    def drip():
        connected[1].sendall(b"\x82\x7e\x10\x00")
        with contextlib.suppress(OSError):
            for _ in range(60):
                connected[1].sendall(b"x")
                time.sleep(0.02)

    start = time.monotonic()
    with beside(drip):
        with pytest.raises(TimeoutError):
            client.receive(0.2)
        assert time.monotonic() - start < 1.0
        client.close()


def test_a_message_that_nobody_takes_is_given_up(client):
    with pytest.raises(TimeoutError):
        client.send(bytes(16 << 20), 0.2)


@pytest.mark.parametrize(
    ("frame", "error", "message"),
    [
        (b"\x82\x7f" + (LARGEST + 1).to_bytes(8, "big"), ConnectionClosed, "message too big"),
        (b"\x81\x02no", ProtocolError, "binary message in one frame"),
        (b"\x02\x02no", ProtocolError, "binary message in one frame"),
        (b"\x82\x82abcdno", ConnectionClosed, "incorrect masking"),
        (b"\x88\x00", ConnectionClosed, "no status received"),
    ],
)
def test_what_is_no_message_is_an_error_at_once(frame, error, message, client, connected):
    connected[1].sendall(frame)
    with pytest.raises(error, match=message):
        client.receive(5.0)


def test_a_ping_is_answered_and_is_no_message(client, connected):
    connected[1].sendall(b"\x89\x02hi\x82\x01x")
    assert client.receive(5.0) == b"x"
    connected[1].settimeout(5.0)
    assert connected[1].recv(100)[:2] == b"\x8a\x82"


def test_whoever_waits_is_woken_when_the_wire_is_closed(client):
    with beside(lambda: (time.sleep(0.2), client.close())), pytest.raises((ConnectionClosed, OSError)):
        client.receive(10.0)
